//! H.264 in MP4, with the index before the frames, so that a browser plays it while it is still loading.

use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::num::NonZeroU32;

use anyhow::{Context, Result, ensure};
use openh264::OpenH264API;
use openh264::encoder::{
    Complexity, Encoder, EncoderConfig, FrameRate, FrameType, IntraFramePeriod, RateControlMode,
    VuiConfig,
};
use openh264::formats::{RgbSliceU8, YUVBuffer};
use shiguredo_mp4::TrackKind;
use shiguredo_mp4::bitstream::h264::{
    H264NalUnitType, H264SampleEntryConfig, LengthSize, build_avc1_box_from_annexb,
    parse_annexb_nal_units,
};
use shiguredo_mp4::boxes::SampleEntry;
use shiguredo_mp4::mux::{
    Mp4FileMuxer, Mp4FileMuxerOptions, Sample, estimate_maximum_moov_box_size,
};

use super::format::FilmFormat;

/// Seconds between key frames, which are the frames that a player can seek to.
const KEY_FRAME_EVERY: u32 = 2;

/// Writes the film.
///
/// # Errors
/// Fails if the encoder cannot be started or skips a frame, if there are more frames than announced, or if the file cannot be
/// written.
pub fn encode(
    file: impl Write + Seek,
    format: FilmFormat,
    frames: impl Iterator<Item = Vec<u8>>,
) -> Result<()> {
    let size = (format.size[0] as usize, format.size[1] as usize);
    let mut encoder = encoder(format.fps)?;
    let mut yuv = YUVBuffer::new(size.0, size.1);
    let timescale =
        NonZeroU32::new(format.fps).context("the frame rate of a film must not be 0")?;
    let mut muxer = Mp4FileMuxer::with_options(Mp4FileMuxerOptions {
        reserved_moov_box_size: estimate_maximum_moov_box_size(&[format.longest]),
        ..Default::default()
    })?;
    let mut file = BufWriter::new(file);
    // The beginning is written last, which a pipe does not allow.
    file.stream_position()?;
    file.write_all(muxer.initial_boxes_bytes())?;
    let mut data_offset = muxer.initial_boxes_bytes().len() as u64;
    for (number, rgb) in frames.enumerate() {
        yuv.read_rgb8(RgbSliceU8::new(&rgb, size));
        let stream = encoder.encode(&yuv).context("cannot encode a frame")?;
        let keyframe = matches!(stream.frame_type(), FrameType::IDR | FrameType::I);
        let stream = stream.to_vec();
        // The first frame carries the description of the stream.
        let config = H264SampleEntryConfig {
            length_size: LengthSize::FourBytes,
        };
        let describe = || build_avc1_box_from_annexb(&stream, &config).map(SampleEntry::Avc1);
        let sample_entry = (number == 0).then(describe).transpose()?;
        let data = units_with_lengths(&stream)?;
        ensure!(!data.is_empty(), "the encoder skipped a frame");
        file.write_all(&data)?;
        muxer.append_sample(&Sample {
            track_kind: TrackKind::Video,
            sample_entry,
            keyframe,
            timescale,
            duration: 1,
            composition_time_offset: None,
            data_offset,
            data_size: data.len(),
        })?;
        data_offset += data.len() as u64;
    }
    let boxes = muxer.finalize()?;
    ensure!(
        boxes.is_faststart_enabled(),
        "the film has more frames than announced"
    );
    for (offset, bytes) in boxes.offset_and_bytes_pairs() {
        file.seek(SeekFrom::Start(offset))?;
        file.write_all(bytes)?;
    }
    Ok(file.flush()?)
}

/// The units of a frame, each behind its length, as the file holds them.
fn units_with_lengths(stream: &[u8]) -> Result<Vec<u8>> {
    let mut data = Vec::new();
    for unit in parse_annexb_nal_units(stream)? {
        // The parameter sets go into the index.
        if !matches!(
            unit.nal_unit_type,
            H264NalUnitType::Sps | H264NalUnitType::Pps
        ) {
            data.extend_from_slice(&u32::try_from(unit.data.len())?.to_be_bytes());
            data.extend_from_slice(unit.data);
        }
    }
    Ok(data)
}

fn encoder(fps: u32) -> Result<Encoder> {
    let config = EncoderConfig::new()
        .max_frame_rate(FrameRate::from_hz(fps as f32))
        // Constant, fine quantisation: half a megabyte for ten seconds of 640 × 480.
        .rate_control_mode(RateControlMode::Off)
        .intra_frame_period(IntraFramePeriod::from_num_frames(KEY_FRAME_EVERY * fps))
        .complexity(Complexity::Low)
        .skip_frames(false)
        .num_threads(1)
        // The colour conversion of `YUVBuffer`.
        .vui(VuiConfig::bt601());
    Encoder::with_api_config(OpenH264API::from_source(), config).context("cannot start the encoder")
}
