//! H.264 in MP4, with the index before the frames, so that a browser plays it while it is still loading.

use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::num::NonZeroU32;

use anyhow::{Context, Result, anyhow, ensure};
use openh264::OpenH264API;
use openh264::encoder::{
    Complexity, Encoder, EncoderConfig, FrameRate, FrameType, IntraFramePeriod, RateControlMode, VuiConfig,
};
use openh264::formats::{RgbSliceU8, YUVBuffer};
use shiguredo_mp4::TrackKind;
use shiguredo_mp4::bitstream::h264::{
    H264NalUnitType, H264SampleEntryConfig, LengthSize, build_avc1_box_from_annexb, parse_annexb_nal_units,
};
use shiguredo_mp4::boxes::SampleEntry;
use shiguredo_mp4::mux::{Mp4FileMuxer, Mp4FileMuxerOptions, Sample, estimate_maximum_moov_box_size};

use super::format::{FilmEncoder, FilmFormat};
use crate::os::OutputFile;

/// Seconds between key frames, which are the frames that a player can seek to.
const KEY_FRAME_EVERY: u32 = 2;

/// An MP4 file being written.
pub(super) struct Mp4Film {
    file: BufWriter<OutputFile>,
    muxer: Mp4FileMuxer,
    /// The position of the next frame in the file.
    position: u64,
    encoder: Encoder,
    size: (usize, usize),
    yuv: YUVBuffer,
    fps: NonZeroU32,
    /// Whether no frame was written yet. The first one carries the description of the stream.
    first: bool,
}

impl Mp4Film {
    /// Starts the file.
    pub(super) fn new(file: OutputFile, format: FilmFormat) -> Result<Self> {
        let size = (format.size[0] as usize, format.size[1] as usize);
        let config = EncoderConfig::new()
            .max_frame_rate(FrameRate::from_hz(format.fps as f32))
            // Constant, fine quantisation: half a megabyte for ten seconds of 640 × 480.
            .rate_control_mode(RateControlMode::Off)
            .intra_frame_period(IntraFramePeriod::from_num_frames(KEY_FRAME_EVERY * format.fps))
            .complexity(Complexity::Low)
            .skip_frames(false)
            .num_threads(1)
            // The colour conversion of `YUVBuffer`.
            .vui(VuiConfig::bt601());
        let encoder =
            Encoder::with_api_config(OpenH264API::from_source(), config).context("cannot start the encoder")?;
        let options = Mp4FileMuxerOptions {
            reserved_moov_box_size: estimate_maximum_moov_box_size(&[format.longest]),
            ..Default::default()
        };
        let muxer = Mp4FileMuxer::with_options(options)?;
        let mut file = BufWriter::new(file);
        file.write_all(muxer.initial_boxes_bytes())?;
        let position = muxer.initial_boxes_bytes().len() as u64;
        let fps = NonZeroU32::new(format.fps).context("the frame rate of a film must not be 0")?;
        let yuv = YUVBuffer::new(size.0, size.1);
        Ok(Self { file, muxer, position, encoder, size, yuv, fps, first: true })
    }
}

impl FilmEncoder for Mp4Film {
    fn push(&mut self, rgb: &[u8]) -> Result<()> {
        self.yuv.read_rgb8(RgbSliceU8::new(rgb, self.size));
        let stream = self.encoder.encode(&self.yuv).context("cannot encode a frame")?;
        let keyframe = matches!(stream.frame_type(), FrameType::IDR | FrameType::I);
        let stream = stream.to_vec();
        let length_size = LengthSize::FourBytes;
        let describe = || build_avc1_box_from_annexb(&stream, &H264SampleEntryConfig { length_size });
        let sample_entry = self.first.then(describe).transpose()?.map(SampleEntry::Avc1);
        self.first = false;
        let mut data = Vec::with_capacity(stream.len());
        for unit in parse_annexb_nal_units(&stream)? {
            // The parameter sets go into the index.
            if !matches!(unit.nal_unit_type, H264NalUnitType::Sps | H264NalUnitType::Pps) {
                data.extend_from_slice(&u32::try_from(unit.data.len())?.to_be_bytes());
                data.extend_from_slice(unit.data);
            }
        }
        ensure!(!data.is_empty(), "the encoder skipped a frame");
        self.file.write_all(&data)?;
        self.muxer.append_sample(&Sample {
            track_kind: TrackKind::Video,
            sample_entry,
            keyframe,
            timescale: self.fps,
            duration: 1,
            composition_time_offset: None,
            data_offset: self.position,
            data_size: data.len(),
        })?;
        self.position += data.len() as u64;
        Ok(())
    }

    fn finish(mut self: Box<Self>) -> Result<OutputFile> {
        let boxes = self.muxer.finalize()?;
        ensure!(boxes.is_faststart_enabled(), "the film has more frames than announced");
        for (offset, bytes) in boxes.offset_and_bytes_pairs() {
            self.file.seek(SeekFrom::Start(offset))?;
            self.file.write_all(bytes)?;
        }
        self.file.into_inner().map_err(|error| anyhow!("{}", error.error()))
    }
}
