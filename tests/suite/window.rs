//! The window, on a display of its own that nobody sees (Xvfb), with keys pressed by xdotool.

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
    /// A display, if this machine has what it takes.
    fn open() -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let mut server = Command::new("Xvfb");
        server
            .args(["-displayfd", "1", "-screen", "0", "1280x720x24", "-nolisten", "tcp", "-fbdir"])
            .arg(folder.path());
        let server = server.stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
        let (Ok(mut server), true) = (server, Command::new("xdotool").arg("version").output().is_ok()) else {
            must_be_possible("the window: Xvfb or xdotool is missing");
            return None;
        };
        let mut line = String::new();
        BufReader::new(server.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let name = format!(":{}", line.trim());
        Some(Self { server, name, folder })
    }

    /// The program on this display.
    fn start(&self, folder: &Path, args: &[&str]) -> Child {
        let mut command = command(folder, args);
        command.env("DISPLAY", &self.name).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
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
        xdotool.args(["sleep", "0.5", "key", "--delay", "200"]).args(keys);
        // A window that a key closes is an error to xdotool; what the keys did is for the caller to see.
        xdotool.stderr(Stdio::null()).status().unwrap();
    }

    /// The pixels `[height, width, 3]` of the screen, without the panels beside the scene.
    fn scene(&self) -> Vec<u8> {
        let path: PathBuf = self.folder.path().join("Xvfb_screen0");
        let dump = fs::read(path).unwrap();
        // XWD: a header of numbers with the highest byte first, the palette, then rows of pixels.
        let word = |i: usize| u32::from_be_bytes(dump[4 * i..4 * i + 4].try_into().unwrap()) as usize;
        let (header, width, height, bytes_per_line, palette) = (word(0), word(4), word(5), word(12), word(19));
        assert_eq!((width, height, word(11)), (1280, 720, 32));
        let pixels = &dump[header + 12 * palette..];
        let row = |y: usize| &pixels[y * bytes_per_line..][4 * 250..4 * 950];
        (0..height).flat_map(|y| row(y).chunks_exact(4).flat_map(|bgrx| [bgrx[2], bgrx[1], bgrx[0]])).collect()
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
            assert!(begun.elapsed() < PATIENCE, "waited in vain: {what}");
            sleep(Duration::from_millis(100));
        }
    }

    /// Waits until the scene stands still, and returns it.
    #[track_caller]
    fn wait_for_rest(&self) -> Vec<u8> {
        self.wait("the scene stands still", |scene| {
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

/// Far from any end of an episode, however slow the machine is.
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
    let Some(display) = Display::open() else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut child = display.start(folder.path(), &WAVE);
    display.wait("the cube is to be seen", |scene| colours_of_the_cube(scene) >= 2);
    let before = display.scene();
    display.wait("the hand moves", |scene| scene != before);

    display.press(&["space"]);
    let paused = display.wait_for_rest();
    display.press(&["Right", "Right", "Right", "Right", "Right", "Right", "Right", "Right"]);
    display.wait("single steps move the hand", |scene| scene != paused);
    let stepped = display.wait_for_rest();
    display.press(&["g"]);
    display.wait("a new goal is shown while time stands still", |scene| scene != stepped);
    let goal = display.wait_for_rest();
    display.press(&["r"]);
    display.wait("a reset is shown while time stands still", |scene| scene != goal);
    let reset = display.wait_for_rest();
    display.press(&["space"]);
    display.wait("the hand moves on", |scene| scene != reset);

    display.press(&["ctrl+q"]);
    let begun = Instant::now();
    while child.try_wait().unwrap().is_none() && begun.elapsed() < PATIENCE {
        sleep(Duration::from_millis(100));
    }
    let _ = child.kill();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(stderr(&output).contains(" steps, 0 episodes to their end"), "{}", stderr(&output));
}

#[test]
fn where_there_is_a_display_play_opens_a_window_that_closes_after_its_episodes() {
    let Some(display) = Display::open() else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut args = vec!["play", "--policy", "zero", "--plain", "--quality", "fast", "--episodes", "2"];
    args.extend(["--set", "env.max_episode_seconds=0.5"]);
    let output = display.start(folder.path(), &args).wait_with_output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(stderr(&output).contains("shown: 100 steps, 2 episodes"), "{}", stderr(&output));
    assert!(output.stdout.is_empty(), "what is shown is not scored");
    // What asks for a result asks for no window.
    args.retain(|arg| !["--plain", "--quality", "fast"].contains(arg));
    for more in ["--headless", "--json"] {
        let output = display.start(folder.path(), &[&args[..], &[more]].concat()).wait_with_output().unwrap();
        assert!(output.status.success() && !output.stdout.is_empty(), "{}", stderr(&output));
        assert!(!stderr(&output).contains("shown"), "{}", stderr(&output));
    }
}

#[test]
fn without_a_display_the_packages_and_the_ways_without_a_window_are_named() {
    let folder = tempfile::tempdir().unwrap();
    for args in [&["view", "--plain"][..], &["play", "--policy", "zero", "--plain", "--window"]] {
        let output = program(folder.path(), args);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{said}");
        for part in ["cannot open a window", "DISPLAY", "apt install libgl1 libxcursor1", "play --headless"] {
            assert!(said.contains(part), "{said}");
        }
        assert!(!said.contains("panicked"), "{said}");
    }
}

#[test]
fn a_display_that_does_not_answer_costs_a_word_and_not_the_score() {
    let folder = tempfile::tempdir().unwrap();
    let args = ["play", "--policy", "zero", "--plain", "--episodes", "1", "--set", "env.max_episode_seconds=0.1"];
    let output = command(folder.path(), &args).env("DISPLAY", ":4242").output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(stderr(&output).contains("cannot open a window"), "{}", stderr(&output));
    assert!(String::from_utf8_lossy(&output.stdout).contains("zero actions"));
}
