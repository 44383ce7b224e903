//! The pictures of `plot` and `play --robustness`.

use std::fs;
use std::path::Path;
use std::process::Command;

use crate::support::{program, stderr, succeeded, train};

/// Fails unless a file is XML. Without Python, only its characters are checked.
#[track_caller]
fn expect_xml(path: &Path) {
    let text = fs::read_to_string(path).unwrap();
    let allowed = |c: char| !(c.is_control() && c != '\n' || matches!(c, '\u{fffe}' | '\u{ffff}'));
    assert!(text.chars().all(allowed), "{text}");
    let parse = "import sys, xml.etree.ElementTree as tree\ntree.parse(sys.argv[1])";
    if let Ok(parsed) = Command::new("python3")
        .args(["-c", parse])
        .arg(path)
        .output()
    {
        assert!(
            parsed.status.success(),
            "{}",
            String::from_utf8_lossy(&parsed.stderr)
        );
    }
}

#[test]
fn a_picture_is_xml_whatever_the_name_of_the_run() {
    let place = tempfile::tempdir().unwrap();
    let (folder, run) = (place.path(), "a\u{1}\u{9f}\u{ffff}<&>\"]]>");
    succeeded(program(
        folder,
        &train(&["--total-steps", "128", "--run-dir", run]),
    ));
    succeeded(program(folder, &["plot", run, "--out", "curves.svg"]));
    let play = [
        "play",
        "--ckpt",
        run,
        "--robustness",
        "--episodes",
        "1",
        "--out",
        "bars.svg",
    ];
    succeeded(program(
        folder,
        &[&play[..], &["--set", "env.max_episode_seconds=0.05"]].concat(),
    ));
    for picture in ["curves.svg", "bars.svg"] {
        expect_xml(&folder.join(picture));
        assert!(
            fs::read_to_string(folder.join(picture))
                .unwrap()
                .contains("a\u{fffd}"),
            "it shows the name"
        );
    }
}

#[test]
fn by_default_a_tenth_of_the_shortest_run_is_smoothed_and_fifty_iterations_at_most() {
    let place = tempfile::tempdir().unwrap();
    for (name, rows) in [("short.csv", 20), ("long.csv", 600)] {
        let rows: String = (1..=rows).map(|i| format!("{i},1,1,{i}\n")).collect();
        let table = format!("env_steps,time/collect_s,time/update_s,loss/value\n{rows}");
        fs::write(place.path().join(name), table).unwrap();
    }
    // The numbers of points of the curves. Shorter lines belong to axes and legend.
    let points = |tables: &[&str]| {
        succeeded(program(
            place.path(),
            &[&["plot", "--metric", "loss/value"], tables].concat(),
        ));
        let svg = fs::read_to_string(place.path().join("learning.svg")).unwrap();
        let lines = svg
            .lines()
            .filter(|line| line.starts_with("<polyline"))
            .map(|line| line.matches(',').count());
        let mut counts: Vec<usize> = lines.filter(|&points| points > 2).collect();
        counts.sort_unstable();
        counts
    };
    assert_eq!(points(&["short.csv"]), [10]);
    assert_eq!(points(&["long.csv"]), [12]);
    assert_eq!(points(&["long.csv", "short.csv"]), [10, 300]);
}

#[test]
fn a_table_of_another_learner_needs_only_its_steps_and_the_metric() {
    let place = tempfile::tempdir().unwrap();
    fs::write(
        place.path().join("ours.csv"),
        "env_steps,time/collect_s,time/update_s,eval/goals\n1,1,1,0\n2,1,1,1\n",
    )
    .unwrap();
    fs::write(
        place.path().join("theirs.csv"),
        "env_steps,eval/goals\n1,0\n2,3\n",
    )
    .unwrap();
    let plot = ["plot", "ours.csv", "theirs.csv", "--metric", "eval/goals"];
    let said = stderr(&succeeded(program(place.path(), &plot)));
    assert!(
        said.contains(": 2 runs") && !said.contains("warning"),
        "{said}"
    );
    let said = stderr(&succeeded(program(
        place.path(),
        &[&plot[..], &["--along", "hours"]].concat(),
    )));
    assert!(
        said.contains("theirs.csv has no column time/collect_s") && said.contains(": 1 run"),
        "{said}"
    );
}
