//! Pictures and films that the program makes, all without a display.

use std::fs::{self, File};
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use openh264::decoder::Decoder;
use openh264::formats::YUVSource;
use shadow_repose::env::Env;
use shadow_repose::repose::{Repose, Task};
use shadow_repose::see::{dress, mesh_files};
use shadow_repose::sim::{Camera, Look, Quality};
use shiguredo_mp4::bitstream::h264::{LengthSize, length_prefixed_to_annexb};
use shiguredo_mp4::boxes::SampleEntry;
use shiguredo_mp4::demux::{Input, Mp4FileDemuxer};

use crate::support::{
    colours_of_the_cube, command, has, must_be_possible, names, program, started, stderr,
    succeeded, task,
};

/// Returns whether pictures can be drawn here. Without EGL it prints a note, or fails if CI has installed EGL.
fn can_draw() -> bool {
    let folder = tempfile::tempdir().unwrap();
    let args = [
        "view",
        "--plain",
        "--quality",
        "fast",
        "--size",
        "64x64",
        "--out",
        "x.png",
    ];
    let output = program(folder.path(), &args);
    let said = stderr(&output);
    assert!(
        output.status.success() || said.contains("apt install libegl1"),
        "{said}"
    );
    output.status.success() || must_be_possible("pictures: EGL is missing")
}

/// Returns the width and height, and the pixels, of a PNG file.
pub(crate) fn picture(path: &Path) -> ([u32; 2], Vec<u8>) {
    let mut reader = png::Decoder::new(std::io::BufReader::new(File::open(path).unwrap()))
        .read_info()
        .unwrap();
    let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut rgb).unwrap();
    assert_eq!(info.color_type, png::ColorType::Rgb);
    ([info.width, info.height], rgb)
}

/// Films an episode of two seconds, with `more` arguments.
fn film(folder: &Path, more: &[&str]) {
    let mut args = vec![
        "play",
        "--ckpt",
        "zero",
        "--set",
        "env.max_episode_seconds=2",
        "--plain",
        "--size",
        "160x120",
    ];
    args.extend(more);
    let output = succeeded(program(folder, &args));
    let leftovers = fs::read_dir(folder)
        .unwrap()
        .filter(|e| e.as_ref().unwrap().path().extension().unwrap() == "partial");
    assert_eq!(leftovers.count(), 0);
    assert!(
        !stderr(&output).contains("Warning"),
        "the encoder prints nothing: {}",
        stderr(&output)
    );
}

/// Returns the luminance of every frame of an MP4 file, the size of the frames, and the duration in seconds.
fn decode_mp4(path: &Path) -> (Vec<Vec<u8>>, [usize; 2], f64) {
    let bytes = fs::read(path).unwrap();
    let at = |name: &[u8]| bytes.windows(4).position(|window| window == name).unwrap();
    assert!(at(b"moov") < at(b"mdat"), "the index comes first");
    let mut demuxer = Mp4FileDemuxer::new();
    while let Some(wanted) = demuxer.required_input() {
        demuxer.handle_input(Input {
            position: wanted.position,
            data: &bytes[wanted.position as usize..],
        });
    }
    let track = &demuxer.tracks().unwrap()[0];
    let duration = track.duration as f64 / f64::from(track.timescale.get());
    let (mut decoder, mut frames, mut size) = (Decoder::new().unwrap(), Vec::new(), [0, 0]);
    while let Some(sample) = demuxer.next_sample().unwrap() {
        if let Some(SampleEntry::Avc1(entry)) = sample.sample_entry {
            size = [entry.visual.width.into(), entry.visual.height.into()];
            for set in entry
                .avcc_box
                .sps_list
                .iter()
                .chain(&entry.avcc_box.pps_list)
            {
                decoder
                    .decode(&[&[0, 0, 0, 1], set.as_slice()].concat())
                    .unwrap();
            }
        }
        let data = &bytes[sample.data_offset as usize..][..sample.data_size];
        let stream = length_prefixed_to_annexb(data, LengthSize::FourBytes).unwrap();
        let frame = decoder
            .decode(&stream)
            .unwrap()
            .expect("each sample is a frame");
        assert_eq!([frame.dimensions().0, frame.dimensions().1], size);
        frames.push(frame.y().to_vec());
    }
    (frames, size, duration)
}

#[test]
fn a_picture_needs_no_display_and_shows_the_cube_in_its_colours() {
    if !can_draw() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    for quality in ["fast", "high"] {
        // A hand that closes slowly would hide two of the sides.
        let args = [
            "view",
            "--plain",
            "--set=env.act_moving_average=1",
            "--size=320x240",
        ];
        let args = [&args[..], &["--quality", quality, "--out"]].concat();
        succeeded(program(folder.path(), &[&args[..], &["near.png"]].concat()));
        succeeded(program(
            folder.path(),
            &[&args[..], &["far.png", "--camera", "150,-27,10"]].concat(),
        ));
        let (size, near) = picture(&folder.path().join("near.png"));
        assert_eq!(size, [320, 240]);
        assert!(
            near.iter().map(|&c| u64::from(c)).sum::<u64>() / near.len() as u64 > 60,
            "not black"
        );
        assert!(
            colours_of_the_cube(&near) >= 3,
            "{}",
            colours_of_the_cube(&near)
        );
        let (_, far) = picture(&folder.path().join("far.png"));
        assert_eq!(
            colours_of_the_cube(&far),
            0,
            "from far away the cube is hardly visible"
        );
    }
}

#[test]
fn an_mp4_film_has_the_frames_the_size_and_the_duration_that_were_asked_for() {
    if !can_draw() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    film(folder.path(), &["--out", "film.mp4"]);
    let (frames, size, duration) = decode_mp4(&folder.path().join("film.mp4"));
    assert_eq!((frames.len(), size, duration), (100, [160, 120], 2.0));
    assert_ne!(frames[0], frames[40], "something moves");
    film(
        folder.path(),
        &["--out", "slow.mp4", "--fps", "30", "--episodes", "2"],
    );
    let (frames, _, duration) = decode_mp4(&folder.path().join("slow.mp4"));
    assert_eq!((frames.len(), duration), (120, 4.0));
}

#[test]
fn a_gif_film_has_the_frames_the_size_and_the_duration_that_were_asked_for() {
    if !can_draw() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    film(folder.path(), &["--out", "film.gif", "--fps", "30"]);
    let mut options = gif::DecodeOptions::new();
    options.set_color_output(gif::ColorOutput::RGBA);
    let mut decoder = options
        .read_info(File::open(folder.path().join("film.gif")).unwrap())
        .unwrap();
    assert_eq!((decoder.width(), decoder.height()), (160, 120));
    let (mut frames, mut hundredths, mut colours) = (0, 0, 0);
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        if frames == 0 {
            assert_eq!(
                (frame.width, frame.height),
                (160, 120),
                "the first frame is whole"
            );
            let rgb: Vec<u8> = frame
                .buffer
                .chunks_exact(4)
                .flat_map(|pixel| pixel[..3].to_vec())
                .collect();
            colours = colours_of_the_cube(&rgb);
        }
        frames += 1;
        hundredths += frame.delay;
    }
    assert_eq!((frames, hundredths), (60, 200));
    assert!(colours >= 2, "the palette has the colours of the cube");
}

#[test]
fn a_film_shows_the_episodes_that_are_scored() {
    if !can_draw() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let args = [
        "play",
        "--ckpt",
        "random",
        "--episodes",
        "3",
        "--seed",
        "5",
        "--json",
        "--out",
    ];
    let scored = succeeded(program(
        folder.path(),
        &[&args[..], &["jsonl:scored"]].concat(),
    ));
    let filmed = [
        "jsonl:filmed",
        "--plain",
        "--out",
        "film.mp4",
        "--size",
        "64x64",
    ];
    let filmed = succeeded(program(folder.path(), &[&args[..], &filmed].concat()));
    assert_eq!(scored.stdout, filmed.stdout);
    let read = |name| fs::read(folder.path().join(name)).unwrap();
    assert_eq!(read("scored"), read("filmed"));
}

#[test]
fn an_interrupted_film_shows_what_was_played() {
    if !can_draw() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let args = [
        "play",
        "--ckpt",
        "random",
        "--plain",
        "--out",
        "film.mp4",
        "--size",
        "64x64",
        "--episodes",
        "200",
    ];
    let child = command(folder.path(), &args)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let unfinished = || {
        let files = fs::read_dir(folder.path())
            .unwrap()
            .map(|entry| entry.unwrap().path());
        files
            .into_iter()
            .find(|path| path.extension().unwrap() == "partial")
    };
    let begun = Instant::now();
    // Frames follow the space that is reserved for the index.
    while unfinished()
        .and_then(|path| fs::metadata(path).ok())
        .map_or(0, |facts| facts.len())
        < 200 * 501 * 16 + 20_000
    {
        assert!(
            begun.elapsed() < Duration::from_secs(120),
            "the film does not grow"
        );
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(
        Command::new("kill")
            .args(["-INT", &child.id().to_string()])
            .status()
            .unwrap()
            .success()
    );
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130), "{}", stderr(&output));
    let (frames, ..) = decode_mp4(&folder.path().join("film.mp4"));
    assert!(frames.len() > 10);
    assert!(unfinished().is_none());
}

#[test]
fn what_is_only_seen_does_not_change_the_physics_by_a_bit() {
    let tetrahedron =
        b"v 0 0 0\nv 9 0 0\nv 0 9 0\nv 0 0 9\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n".to_vec();
    let look = Look {
        dress: Some(dress("rh_", vec![tetrahedron; mesh_files().len()])),
        size: [320, 240],
        camera: Some(Camera {
            azimuth: 10.0,
            elevation: -80.0,
            distance: 2.0,
        }),
        quality: Quality::Fast,
        plain: false,
    };
    let plain = task(&[]);
    let dressed = plain.for_display(&look).unwrap();
    same_physics(&plain, &dressed);
}

/// Steps both tasks under the same actions, and compares every bit.
fn same_physics(plain: &Arc<Task>, dressed: &Arc<Task>) {
    let (mut plain, mut dressed): ((Repose, Vec<f32>), (Repose, Vec<f32>)) =
        (started(plain), started(dressed));
    for step in 0..400 {
        let action: Vec<f32> = (0..20)
            .map(|i| ((step * (i + 3)) as f32 * 0.07).sin())
            .collect();
        let transitions =
            [&mut plain, &mut dressed].map(|(env, observation)| env.step(&action, observation));
        assert_eq!(transitions[0], transitions[1]);
        assert_eq!(plain.1, dressed.1);
    }
    assert_eq!(plain.0.sim.qpos(), dressed.0.sim.qpos());
}

#[test]
fn what_a_custom_scene_is_given_to_be_seen_does_not_change_its_physics_by_a_bit() {
    // The built-in scene without lights, sky and the plates on the cubes.
    let words = [
        "<light ",
        "castshadow=\"false\"/>",
        "type=\"skybox\"",
        "size=\".0005",
        "size=\".022",
    ];
    let text = include_str!("../../assets/shadow_hand/scene.xml");
    let bare: Vec<&str> = text
        .lines()
        .filter(|line| !words.iter().any(|word| line.contains(word)))
        .collect();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bare.xml");
    // What a class says about the mass of its geoms must not make the plates heavy.
    let bare = bare
        .join("\n")
        .replace("<default>\n", "<default>\n    <geom mass=\".02\"/>\n");
    assert!(bare.contains("<geom mass="));
    std::fs::write(&path, bare).unwrap();
    let plain = task(&[&format!("env.model={}", path.display())]);
    let look = Look {
        dress: None,
        size: [320, 240],
        camera: None,
        quality: Quality::Fast,
        plain: false,
    };
    let furnished = plain.for_display(&look).unwrap();
    assert_eq!(marks(&furnished), 12, "a plate for each face of both cubes");
    same_physics(&plain, &furnished);
    if can_draw() {
        let args = [
            "view",
            "--quality",
            "fast",
            "--size",
            "320x240",
            "--out",
            "x.png",
            "--set",
        ];
        succeeded(program(
            folder.path(),
            &[&args[..], &[&format!("env.model={}", path.display())]].concat(),
        ));
        let (_, rgb) = picture(&folder.path().join("x.png"));
        assert!(
            colours_of_the_cube(&rgb) >= 2,
            "the faces of the cube can be told apart"
        );
    }
}

/// The number of shapes in the colours of the faces of the built-in cube.
fn marks(task: &Task) -> usize {
    let colours = [
        [0.8, 0.1],
        [0.95, 0.45],
        [0.1, 0.6],
        [0.1, 0.3],
        [0.93, 0.93],
        [0.95, 0.82],
    ];
    let drawing = task.scene.drawing(None, None);
    let geoms = drawing.scene["geoms"].as_array().unwrap();
    let is_mark = |geom: &&serde_json::Value| {
        let colour = [0, 1].map(|i| geom["rgba"][i].as_f64().unwrap());
        colours
            .iter()
            .any(|known| (0..2).all(|i| (known[i] - colour[i]).abs() < 1e-6))
    };
    geoms.iter().filter(is_mark).count()
}

#[test]
fn the_sides_of_any_object_and_of_its_goal_can_be_told_apart_and_a_camera_frames_them() {
    let scene = include_str!("three_fingers.xml");
    let shape = "<geom type=\"box\" size=\".025 .025 .03\"";
    assert!(scene.contains(shape));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.xml");
    let model = format!("env.model={}", path.display());
    let look = Look {
        dress: None,
        size: [320, 240],
        camera: None,
        quality: Quality::Fast,
        plain: false,
    };
    let mesh =
        "<asset><mesh name=\"part\" vertex=\"0 0 0 .05 0 0 0 .03 0 0 0 .02\"/></asset><worldbody>";
    for (other, count) in [
        (shape.to_owned(), 12),
        ("<geom type=\"sphere\" size=\".03\"".into(), 12),
        ("<geom type=\"cylinder\" size=\".03 .02\"".into(), 12),
        ("<geom type=\"mesh\" mesh=\"part\"".into(), 12),
        (format!("<geom type=\"sphere\" size=\".01\"/>{shape}"), 12),
        (format!("{shape} material=\"own\""), 12),
        (
            format!("<geom type=\"sphere\" size=\".01\" rgba=\"1 0 0 1\"/>{shape}"),
            0,
        ),
        (
            format!("<geom type=\"sphere\" size=\".01\" rgba=\"1 0 0 1\" group=\"3\"/>{shape}"),
            12,
        ),
    ] {
        let assets = mesh.replace("<mesh", "<material name=\"own\"/><mesh");
        let text = scene.replace(shape, &other).replace("<worldbody>", &assets);
        std::fs::write(&path, text).unwrap();
        let plain = task(&[&model]);
        let furnished = plain.for_display(&look).unwrap();
        assert_eq!(marks(&furnished), count, "{other}");
        let prints = [&plain, &furnished].map(|task| task.scene.fingerprint());
        assert_eq!(prints[0], prints[1], "{other}");
        let drawing = furnished.scene.drawing(None, None).scene;
        let centre = drawing["camera"]["center"][2].as_f64().unwrap();
        let floor = drawing["floor"].as_f64().unwrap();
        let [_, _, goal] = furnished.goal_place();
        assert!(
            (0.2..goal).contains(&centre) && floor < 0.2,
            "{centre} {floor}"
        );
    }
    let own = scene.replace(
        "<worldbody>",
        "<statistic center=\"1 2 3\" extent=\".5\"/><worldbody>",
    );
    std::fs::write(&path, own).unwrap();
    let shown = task(&[&model]).for_display(&look).unwrap();
    let camera = shown.scene.drawing(None, None).scene["camera"].take();
    assert_eq!(camera["center"], serde_json::json!([1.0, 2.0, 3.0]));
    assert_eq!(camera["distance"], serde_json::json!(0.75));
}

#[test]
fn a_goal_that_is_added_has_the_colour_of_the_object_or_of_its_material() {
    let scene = include_str!("three_fingers.xml");
    let shape = "<geom type=\"box\" size=\".025 .025 .03\"";
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.xml");
    let assets = "<asset><material name=\"own\" rgba=\".7 .2 .1 1\"/></asset><worldbody>";
    for (look, expected) in [
        ("material=\"own\"", [0.7, 0.2, 0.1, 0.5]),
        ("rgba=\".3 .4 .6 1\"", [0.3, 0.4, 0.6, 0.5]),
        ("material=\"own\" rgba=\".3 .4 .6 1\"", [0.3, 0.4, 0.6, 0.5]),
    ] {
        let text = scene
            .replace(shape, &format!("{shape} {look}"))
            .replace("<worldbody>", assets);
        std::fs::write(&path, text).unwrap();
        let shown = task(&[&format!("env.model={}", path.display())])
            .for_display(&Look {
                dress: None,
                size: [64, 64],
                camera: None,
                quality: Quality::Fast,
                plain: false,
            })
            .unwrap();
        let drawing = shown.scene.drawing(None, None).scene;
        let is_goal = |geom: &&serde_json::Value| geom["rgba"][3] == 0.5;
        let mut geoms = drawing["geoms"].as_array().unwrap().iter();
        let goal = geoms
            .find(is_goal)
            .expect("a shape that can be seen through");
        for (channel, expected) in expected.into_iter().enumerate() {
            let found = goal["rgba"][channel].as_f64().unwrap();
            assert!((found - expected).abs() < 1e-6, "{look}: {}", goal["rgba"]);
        }
    }
}

#[test]
fn meshes_that_are_no_meshes_are_an_error_with_their_name() {
    let look = Look {
        dress: Some(dress("rh_", vec![b"rubbish".to_vec(); mesh_files().len()])),
        size: [64, 64],
        camera: None,
        quality: Quality::Fast,
        plain: false,
    };
    let refusal = task(&[]).for_display(&look).err().unwrap().to_string();
    assert!(refusal.contains(".obj"), "{refusal}");
}

#[test]
fn without_the_network_the_primitives_are_shown_and_it_is_said() {
    if !can_draw() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let args = [
        "view",
        "--quality",
        "fast",
        "--size",
        "64x64",
        "--out",
        "x.png",
    ];
    let mut command = command(folder.path(), &args);
    // Without a program named python3 nothing can be fetched.
    let output = command
        .env("XDG_CACHE_HOME", folder.path().join("cache"))
        .env("PATH", folder.path())
        .output()
        .unwrap();
    let said = stderr(&succeeded(output));
    assert!(
        said.contains("primitives are shown instead")
            && said.contains("python3 could not be started"),
        "{said}"
    );
    assert!(folder.path().join("x.png").exists());
    assert_eq!(
        names(&folder.path().join("cache/shadow-repose")),
        ["shadow-hand-meshes.failed"],
        "no unfinished file is left"
    );
}

#[test]
fn without_egl_the_packages_are_named() {
    let folder = tempfile::tempdir().unwrap();
    for args in [
        ["view", "--plain", "--out", "x.png"],
        ["play", "--ckpt=zero", "--plain", "--out=x.mp4"],
    ] {
        let mut command = command(folder.path(), &args);
        let output = command
            .env("__EGL_VENDOR_LIBRARY_DIRS", "/nonexistent")
            .output()
            .unwrap();
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{said}");
        for part in ["cannot draw", "apt install libegl1 libgl1-mesa-dri"] {
            assert!(said.contains(part), "{said}");
        }
        assert!(!said.contains("panicked"), "{said}");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}

#[test]
fn learning_curves_are_drawn_as_png_too() {
    let folder = tempfile::tempdir().unwrap();
    let mut table = "env_steps,time/collect_s,time/update_s,loss\n".to_owned();
    (0..100).for_each(|row| table += &format!("{row}000000,1,1,{}\n", 100 - row));
    fs::write(folder.path().join("metrics.csv"), table).unwrap();
    let args = [
        "plot", ".", "--metric", "loss", "--smooth", "5", "--out", "x.png", "--size", "300x200",
    ];
    succeeded(program(folder.path(), &args));
    let (size, rgb) = picture(&folder.path().join("x.png"));
    assert_eq!(size, [300, 200]);
    // The first curve is blue, and falls from the upper left to the lower right.
    let blue = |x: usize, y: usize| matches!(rgb[3 * (300 * y + x)..][..3], [r, g, b] if b > 150 && r < 60 && g < 160);
    let height = |columns: std::ops::Range<usize>| {
        let found: Vec<usize> = columns
            .flat_map(|x| (0..200).filter(move |&y| blue(x, y)))
            .collect();
        found.iter().sum::<usize>() as f64 / found.len() as f64
    };
    assert!(
        height(200..220) > height(120..140) + 20.0,
        "{} {}",
        height(120..140),
        height(200..220)
    );
}

#[test]
fn pictures_and_films_that_cannot_be_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |args: &[&str], code: i32, part: &str| {
        let output = program(folder.path(), args);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(code), "{args:?} {said}");
        assert!(
            said.contains(part) && !said.contains("panicked"),
            "{args:?} {said}"
        );
    };
    refused(
        &["view", "--out", "x.png", "--size", "640"],
        2,
        "e.g. 640x480",
    );
    refused(
        &["view", "--out", "x.png", "--size", "8x8"],
        2,
        "from 16 to 3840",
    );
    refused(
        &["view", "--out", "x.png", "--camera", "1,2"],
        2,
        "three numbers",
    );
    refused(
        &["view", "--out", "x.png", "--camera", "1,2,-3"],
        2,
        "from 0.05 to 10",
    );
    refused(
        &["view", "--out", "x.png", "--quality", "best"],
        2,
        "possible values: fast, high",
    );
    refused(&["play", "--fps", "20"], 2, "it applies only to a film");
    refused(&["play", "--window", "--out", "x.mp4"], 2, "--window");
    if !can_draw() {
        return;
    }
    let pipe = ["play", "--ckpt", "zero", "--out", "mp4:/dev/stdout"];
    refused(&pipe, 1, "Illegal seek");
    let film = [
        "play",
        "--ckpt",
        "zero",
        "--plain",
        "--set",
        "env.max_episode_seconds=0.1",
        "--out",
    ];
    let refused_film = |more: &[&str], part: &str| refused(&[&film[..], more].concat(), 1, part);
    for name in ["x.avi", "x", "avi:x", ".gif"] {
        refused(
            &[&film[..], &[name]].concat(),
            2,
            "must end in .mp4 or .gif",
        );
    }
    refused_film(&["x.mp4", "--size", "65x64"], "must be even");
    refused_film(&["x.mp4", "--episodes", "1000000"], "at most 2000000");
    refused_film(&["x.gif", "--fps", "60"], "at most 50");
    refused_film(&["missing/x.mp4"], "missing/x.mp4");
    symlink("/dev/full", folder.path().join("full.mp4")).unwrap();
    if has("/dev/full") {
        refused_film(&["full.mp4"], "full.mp4");
    }
    refused(
        &["view", "--plain", "--out", "x.jpg"],
        2,
        "must end in .png",
    );
    refused(
        &["view", "--plain", "--out", "missing/x.png"],
        1,
        "missing/x.png",
    );
    assert_eq!(
        fs::read_dir(folder.path()).unwrap().count(),
        1,
        "only the link"
    );
}

#[test]
fn the_camera_is_where_it_was_asked_to_be_with_another_mass_too() {
    if !can_draw() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    // The upper half shows the goal and the sky. The cube, below, moves according to its mass.
    let upper_half = |camera: &str, more: &[&str]| {
        let args = [
            "view",
            "--plain",
            "--quality",
            "fast",
            "--size",
            "64x64",
            "--camera",
            camera,
        ];
        succeeded(program(
            folder.path(),
            &[&args[..], &["--out", "x.png"], more].concat(),
        ));
        let (_, rgb) = picture(&folder.path().join("x.png"));
        rgb[..rgb.len() / 2].to_vec()
    };
    let usual = upper_half("150,-27,0.3", &[]);
    assert!(usual == upper_half("150,-27,0.3", &["--set", "env.cube_mass_scale=2"]));
    assert!(usual != upper_half("150,-27,0.4", &[]));
}
