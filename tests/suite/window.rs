//! The window, on a virtual display (Xvfb), with keys pressed by xdotool.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use crate::support::{colours_of_the_cube, command, must_be_possible, program, stderr};

const PATIENCE: Duration = Duration::from_secs(60);

/// An X server that draws into a file.
struct Display {
    server: Child,
    name: String,
    folder: tempfile::TempDir,
}

impl Display {
    /// Opens a display if this machine has the necessary programs.
    fn open() -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let mut server = Command::new("Xvfb");
        server
            .args([
                "-displayfd",
                "1",
                "-screen",
                "0",
                "1280x720x24",
                "-nolisten",
                "tcp",
                "-fbdir",
            ])
            .arg(folder.path());
        let server = server.stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
        let (Ok(mut server), true) = (
            server,
            Command::new("xdotool").arg("version").output().is_ok(),
        ) else {
            must_be_possible("the window: Xvfb or xdotool is missing");
            return None;
        };
        let mut line = String::new();
        BufReader::new(server.stdout.take().unwrap())
            .read_line(&mut line)
            .unwrap();
        let name = format!(":{}", line.trim());
        Some(Self {
            server,
            name,
            folder,
        })
    }

    /// Starts the program on this display.
    fn start(&self, folder: &Path, args: &[&str]) -> Child {
        let mut command = command(folder, args);
        command
            .env("DISPLAY", &self.name)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap()
    }

    /// Presses keys in the window.
    fn press(&self, keys: &[&str]) {
        let mut xdotool = Command::new("timeout");
        xdotool.env("DISPLAY", &self.name).args([
            "60",
            "xdotool",
            "search",
            "--sync",
            "--name",
            "shadow-repose",
            "windowfocus",
        ]);
        // The window takes the focus a little later.
        xdotool
            .args(["sleep", "0.5", "key", "--delay", "200"])
            .args(keys);
        // xdotool reports an error if a key closes the window. The caller checks what the keys did.
        xdotool.stderr(Stdio::null()).status().unwrap();
    }

    /// Returns the pixels `[height, width, 3]` of the screen, without the panels beside the scene.
    fn scene(&self) -> Vec<u8> {
        self.pixels(250..950)
    }

    /// Returns the fraction of the leftmost part of the screen that has the dark background of a panel.
    fn panel_at_the_left(&self) -> f64 {
        let pixels = self.pixels(0..150);
        let is_background = |rgb: &&[u8]| rgb[0] < 45 && rgb[1] == rgb[0] && rgb[2] == rgb[0];
        pixels.chunks_exact(3).filter(is_background).count() as f64 / (pixels.len() / 3) as f64
    }

    /// Returns the pixels `[height, width, 3]` of these columns of the screen.
    fn pixels(&self, columns: std::ops::Range<usize>) -> Vec<u8> {
        let path: PathBuf = self.folder.path().join("Xvfb_screen0");
        let dump = fs::read(path).unwrap();
        // XWD: a big-endian header, the palette, then rows of pixels.
        let word =
            |i: usize| u32::from_be_bytes(dump[4 * i..4 * i + 4].try_into().unwrap()) as usize;
        let (header, width, height, bytes_per_line, palette) =
            (word(0), word(4), word(5), word(12), word(19));
        assert_eq!((width, height, word(11)), (1280, 720, 32));
        let pixels = &dump[header + 12 * palette..];
        let row = |y: usize| &pixels[y * bytes_per_line..][4 * columns.start..4 * columns.end];
        (0..height)
            .flat_map(|y| {
                row(y)
                    .chunks_exact(4)
                    .flat_map(|bgrx| [bgrx[2], bgrx[1], bgrx[0]])
            })
            .collect()
    }

    /// Waits until the scene passes the test, and returns it.
    #[track_caller]
    fn wait(&self, what: &str, test: impl Fn(&[u8]) -> bool) -> Vec<u8> {
        let begun = Instant::now();
        loop {
            let scene = self.scene();
            if test(&scene) {
                return scene;
            }
            assert!(begun.elapsed() < PATIENCE, "timed out waiting until {what}");
            sleep(Duration::from_millis(100));
        }
    }

    /// Waits until the scene stops changing, and returns it.
    #[track_caller]
    fn wait_for_rest(&self) -> Vec<u8> {
        self.wait("the scene stops changing", |scene| {
            sleep(Duration::from_millis(1500));
            self.scene() == scene
        })
    }
}

impl Drop for Display {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

/// The arguments for an episode that does not end during a test, however slow the machine is.
const WAVE: [&str; 12] = [
    "view",
    "--plain",
    "--quality",
    "fast",
    "--actions",
    "wave",
    "--seed",
    "3",
    "--set",
    "env.max_episode_seconds=9000",
    "--set",
    "env.fall_dist=9",
];

#[test]
fn the_window_shows_the_cube_and_keys_pause_step_and_close_it() {
    let Some(display) = Display::open() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let mut child = display.start(folder.path(), &WAVE);
    display.wait("the cube is visible", |scene| {
        colours_of_the_cube(scene) >= 2
    });
    let before = display.scene();
    display.wait("the hand moves", |scene| scene != before);

    display.press(&["space"]);
    let paused = display.wait_for_rest();
    display.press(&[
        "Right", "Right", "Right", "Right", "Right", "Right", "Right", "Right",
    ]);
    display.wait("single steps move the hand", |scene| scene != paused);
    let stepped = display.wait_for_rest();
    display.press(&["g"]);
    display.wait("a new goal is shown while paused", |scene| scene != stepped);
    let goal = display.wait_for_rest();
    display.press(&["r"]);
    display.wait("a reset is shown while paused", |scene| scene != goal);
    let reset = display.wait_for_rest();
    display.press(&["space"]);
    display.wait("the hand moves again", |scene| scene != reset);

    assert!(
        display.panel_at_the_left() < 0.1,
        "MuJoCo's own panel is closed"
    );
    display.press(&["x"]);
    display.wait("a key opens MuJoCo's own panel", |_| {
        display.panel_at_the_left() > 0.5
    });

    display.press(&["ctrl+q"]);
    let begun = Instant::now();
    while child.try_wait().unwrap().is_none() && begun.elapsed() < PATIENCE {
        sleep(Duration::from_millis(100));
    }
    let _ = child.kill();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(
        stderr(&output).contains(" steps, 0 episodes completed"),
        "{}",
        stderr(&output)
    );
}

#[test]
fn where_there_is_a_display_play_opens_a_window_that_closes_after_its_episodes() {
    let Some(display) = Display::open() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let mut args = vec![
        "play",
        "--ckpt",
        "zero",
        "--plain",
        "--quality",
        "fast",
        "--episodes",
        "2",
    ];
    args.extend(["--set", "env.max_episode_seconds=0.5"]);
    let output = display
        .start(folder.path(), &args)
        .wait_with_output()
        .unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(
        stderr(&output).contains("shown: 100 steps, 2 episodes"),
        "{}",
        stderr(&output)
    );
    assert!(
        output.stdout.is_empty(),
        "episodes in a window are not scored"
    );
    // Options that request a result open no window.
    args.retain(|arg| !["--plain", "--quality", "fast"].contains(arg));
    for more in ["--headless", "--json"] {
        let output = display
            .start(folder.path(), &[&args[..], &[more]].concat())
            .wait_with_output()
            .unwrap();
        assert!(
            output.status.success() && !output.stdout.is_empty(),
            "{}",
            stderr(&output)
        );
        assert!(!stderr(&output).contains("shown"), "{}", stderr(&output));
    }
}

#[test]
fn without_a_display_the_packages_and_the_ways_without_a_window_are_named() {
    let folder = tempfile::tempdir().unwrap();
    for args in [
        &["view", "--plain"][..],
        &["play", "--ckpt", "zero", "--plain", "--window"],
    ] {
        let output = program(folder.path(), args);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{said}");
        for part in [
            "cannot open a window",
            "DISPLAY",
            "apt install libgl1 libxcursor1",
            "--web shows the hand",
        ] {
            assert!(said.contains(part), "{said}");
        }
        assert!(!said.contains("panicked"), "{said}");
    }
}

#[test]
fn a_display_that_does_not_answer_costs_a_word_and_not_the_score() {
    let folder = tempfile::tempdir().unwrap();
    let args = [
        "play",
        "--ckpt",
        "zero",
        "--plain",
        "--episodes",
        "1",
        "--set",
        "env.max_episode_seconds=0.1",
    ];
    let output = command(folder.path(), &args)
        .env("DISPLAY", ":4242")
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(
        stderr(&output).contains("cannot open a window"),
        "{}",
        stderr(&output)
    );
    assert!(String::from_utf8_lossy(&output.stdout).contains("zero actions"));
}
