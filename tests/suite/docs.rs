//! The documents: what they repeat from the program is true, their links lead somewhere, and their lines can be read in a diff.

use crate::support::task;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use shadow_repose::repose::{ACTUATORS, FINGERTIPS, Group, JOINTS};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(name: &str) -> String {
    fs::read_to_string(root().join(name)).unwrap()
}

/// Returns the documents that people read: in the root, in docs/ and in docs/curves/.
fn documents() -> Vec<PathBuf> {
    let is_document = |path: &PathBuf| path.extension().is_some_and(|kind| kind == "md");
    let folders = [
        root().to_owned(),
        root().join("docs"),
        root().join("docs/curves"),
    ];
    let found: Vec<PathBuf> = folders
        .iter()
        .flat_map(|folder| {
            fs::read_dir(folder)
                .unwrap()
                .map(|entry| entry.unwrap().path())
        })
        .filter(is_document)
        .collect();
    assert!(found.len() > 7, "{found:?}");
    found
}

#[test]
fn the_table_of_the_observation_is_the_one_of_the_program() {
    let text = read("docs/OBSERVATION.md");
    let task = task(&["env.known.friction=1"]);
    let groups: Vec<&Group> = task.hand.layout.groups().collect();
    for Group {
        name,
        start,
        length,
        unit,
        ..
    } in &groups
    {
        let row = format!(
            "| {start} … {} | `{name}` | {length} | {unit} |",
            start + length - 1
        );
        assert!(text.contains(&row), "{row}");
    }
    assert_eq!(
        text.lines()
            .filter(|line| line.contains(" … ") && line.starts_with("| "))
            .count(),
        groups.len()
    );
    for (what, names) in [
        ("joints", &JOINTS[..]),
        ("actuators", &ACTUATORS),
        (
            "fingertips",
            &FINGERTIPS
                .map(|tip| format!("rh_{tip}"))
                .each_ref()
                .map(String::as_str),
        ),
    ] {
        let row = format!("| {what} | {} |", names.join(" "));
        assert!(text.contains(&row), "{row}");
    }
}

#[test]
fn scores_in_the_readme_are_those_of_the_results() {
    let (readme, results) = (read("README.md"), read("docs/RESULTS.md"));
    let section = readme
        .split("## ")
        .find(|section| section.starts_with("Results"))
        .unwrap();
    let rows = section
        .lines()
        .filter(|line| line.starts_with("| ") && line.contains(|c: char| c.is_ascii_digit()));
    let rows: Vec<&str> = rows.collect();
    assert!(rows.len() >= 3, "{rows:?}");
    for row in rows {
        assert!(
            results.lines().any(|line| line.trim() == row),
            "docs/RESULTS.md lacks the row {row}"
        );
    }
}

#[test]
fn the_readme_is_short_and_names_the_test_command() {
    let readme = read("README.md");
    assert!(readme.lines().count() <= 120);
    assert!(readme.contains("cargo test --release"));
    assert!(read("docs/LEARNING.md").lines().count() <= 200);
}

#[test]
fn lines_of_documents_are_short_but_for_tables_and_addresses() {
    for path in documents() {
        for (number, line) in fs::read_to_string(&path).unwrap().lines().enumerate() {
            let may_be_long = line.trim_start().starts_with('|') || line.contains("https://");
            let length = line.chars().count();
            assert!(
                may_be_long || length <= 140,
                "{}:{}: {length} characters",
                path.display(),
                number + 1
            );
        }
    }
}

#[test]
fn relative_links_lead_to_files_and_headings() {
    for path in documents() {
        let text = fs::read_to_string(&path).unwrap();
        for link in text
            .split("](")
            .skip(1)
            .map(|rest| rest.split(')').next().unwrap())
        {
            if link.starts_with("https://") {
                continue;
            }
            let (file, heading) = link.split_once('#').unwrap_or((link, ""));
            let target = if file.is_empty() {
                path.clone()
            } else {
                path.parent().unwrap().join(file)
            };
            assert!(target.exists(), "{}: {link}", path.display());
            if !heading.is_empty() {
                let text = fs::read_to_string(&target).unwrap();
                let headings = text
                    .lines()
                    .filter(|line| line.starts_with('#'))
                    .map(anchor);
                assert!(
                    headings.into_iter().any(|found| found == heading),
                    "{}: {link}",
                    path.display()
                );
            }
        }
    }
}

/// Returns the anchor of a heading, as GitHub makes it.
fn anchor(heading: &str) -> String {
    let text = heading.trim_start_matches('#').trim().to_lowercase();
    let kept = text
        .chars()
        .filter(|c| c.is_alphanumeric() || "-_ ".contains(*c));
    kept.map(|c| if c == ' ' { '-' } else { c }).collect()
}

#[test]
fn every_setting_and_option_that_the_documents_name_exists() {
    let settings = include_str!("../../configs/repose.toml");
    let mut help = String::new();
    for command in shadow_repose::cli::command().get_subcommands_mut() {
        help += &command.render_long_help().to_string();
    }
    // The documents name options of this script beside the program's.
    help += include_str!("../../examples/sweep/sweep.py");
    for path in documents()
        .into_iter()
        .filter(|path| !path.ends_with("CHANGELOG.md"))
    {
        let text = fs::read_to_string(&path).unwrap();
        for word in text.split(|c: char| c.is_whitespace() || "`(),:;|\"'".contains(c)) {
            let word = word.split('=').next().unwrap().trim_end_matches('.');
            let section = word
                .split_once('.')
                .filter(|(section, _)| ["env", "training", "ppo", "run"].contains(section));
            if let Some((_, key)) = section.filter(|(_, key)| !key.is_empty() && *key != "…") {
                let key = key.split('.').next().unwrap();
                let is_known = settings
                    .lines()
                    .any(|line| line.split(" =").next() == Some(key));
                let stands_for_some =
                    key.contains('…') || key.contains('*') || ["KEY", "lock"].contains(&key);
                assert!(is_known || stands_for_some, "{}: {word}", path.display());
            }
            if word.starts_with("--") && word.len() > 3 && text.contains("shadow-repose") {
                const OF_OTHERS: [&str; 27] = [
                    "--lib",
                    "--version",
                    "--rm",
                    "--entrypoint",
                    "--ntasks",
                    "--kill-on-bad-exit",
                    "--features",
                    "--map-by",
                    "--bind-to",
                    "--mpi",
                    "--nodes",
                    "--ntasks-per-node",
                    "--signal",
                    "--check",
                    "--release",
                    "--logdir",
                    "--path",
                    "--no-default-features",
                    "--locked",
                    "--all-targets",
                    "--test",
                    "--ignored",
                    "--array",
                    "--mem",
                    "--time",
                    "--requeue",
                    "--undo",
                ];
                let of_others = OF_OTHERS.contains(&word)
                    || word.starts_with("--cpus")
                    || word.starts_with("---");
                assert!(
                    of_others || help.contains(word),
                    "{}: {word}",
                    path.display()
                );
            }
        }
    }
}

/// The evaluations that are nearest to these steps, by both commands of the built-in policy: goals, and drops for the first
/// command.
#[test]
fn goals_by_time_are_those_of_the_tables() {
    let learning = read("docs/LEARNING.md");
    let second = "A second command then";
    let of_today = [
        (", seed 0", "default-0"),
        (", seed 1", "default-1"),
        (", seed 2", "default-2"),
        (", seed 0, f32", "default-0-f32"),
        (", seed 1, f32", "default-1-f32"),
        (", seed 2, f32", "default-2-f32"),
    ];
    let of_earlier = [
        (", less noise, seed 1", "less-noise-1"),
        (", 2026-11-25, seed 0", "before-0"),
        (", 2026-11-25, seed 1", "before-1"),
        (", 2026-11-25, seed 2", "before-2"),
    ];
    for (title, kind, curves, steps_per_s) in [
        ("## What to expect", "", &of_today[..], 21_500.0),
        ("## Earlier defaults", "", &of_earlier, 21_500.0),
        (second, " more", &[("", "continue-0")], 19_900.0),
    ] {
        let by_time = learning.split(title).nth(1).unwrap();
        let cells = |start: &str| -> Vec<String> {
            let row = by_time
                .lines()
                .find_map(|line| line.strip_prefix(&format!("| {start} |")))
                .unwrap();
            let cells = row
                .trim()
                .trim_end_matches('|')
                .split('|')
                .map(|cell| cell.trim().to_owned());
            cells.filter(|cell| !cell.is_empty()).collect()
        };
        let steps = cells(&format!("steps{kind}"));
        let steps: Vec<f64> = steps
            .iter()
            .map(|cell| cell.trim_end_matches(" M").parse().unwrap())
            .collect();
        let minutes = steps
            .iter()
            .map(|at| (at * 1e6 / steps_per_s / 60.0).round());
        let shown: Vec<f64> = cells(&format!("minutes{kind}"))
            .iter()
            .map(|cell| cell.parse().unwrap())
            .collect();
        assert!(
            minutes
                .zip(&shown)
                .all(|(expected, shown)| (expected - shown).abs() <= 1.0),
            "{title}: {shown:?}"
        );
        assert_eq!(shown.len(), steps.len(), "{title}");
        for (of_curve, curve) in curves {
            let evaluations = evaluations(&format!("docs/curves/{curve}.csv"));
            // A cell is left out only where the run had ended.
            let last = evaluations.last().unwrap()[0];
            let nearest = steps.iter().filter(|at| **at < last + 1.0).map(|at| {
                let distance = |of: &&[f64; 3]| (of[0] - at).abs();
                evaluations
                    .iter()
                    .min_by(|a, b| distance(a).total_cmp(&distance(b)))
                    .unwrap()
            });
            let digits = if title == second { 1 } else { 2 };
            let goals: Vec<String> = nearest
                .clone()
                .map(|[_, goals, _]| format!("{goals:.digits$}"))
                .collect();
            assert_eq!(
                cells(&format!("goals{of_curve}")),
                goals,
                "{title}: {curve}"
            );
            if curve.starts_with("default") && !curve.ends_with("f32") {
                let drops: Vec<String> = nearest
                    .map(|[.., drops]| format!("{:.0}", 100.0 * drops))
                    .collect();
                assert_eq!(
                    cells(&format!("drops, %{of_curve}")),
                    drops,
                    "{title}: {curve}"
                );
            }
        }
    }
}

/// Returns the evaluations in a table of a training: millions of steps, goals per episode, and the share of dropped cubes.
fn evaluations(path: &str) -> Vec<[f64; 3]> {
    let table = read(path);
    let mut lines = table
        .lines()
        .map(|line| line.split(',').collect::<Vec<&str>>());
    let header = lines.next().unwrap();
    let [env_steps, goals, drops] = ["env_steps", "eval/goals", "eval/drop_rate"]
        .map(|name| header.iter().position(|column| *column == name).unwrap());
    let number = |cell: &str| cell.parse::<f64>().ok();
    lines
        .filter_map(|row| {
            Some([
                number(row[env_steps])? / 1e6,
                number(row[goals])?,
                number(row[drops])?,
            ])
        })
        .collect()
}

#[test]
fn every_command_of_the_workflows_exists_and_packages_are_made_for_every_platform() {
    // What the forge's runners have beside this checkout.
    const INSTALLED: [&str; 5] = ["cargo", "cd", "sha256sum", "gh", "rm"];
    let mut commands = 0;
    for name in ["ci", "release"] {
        let text = read(&format!(".github/workflows/{name}.yml"));
        let run = text
            .lines()
            .filter_map(|line| line.trim_start().strip_prefix("- run: "));
        for command in run.flat_map(|line| line.split(" && ")) {
            commands += 1;
            let program = command.split_whitespace().next().unwrap();
            if INSTALLED.contains(&program) {
                continue;
            }
            let mode = fs::metadata(root().join(program)).map(|facts| facts.permissions().mode());
            assert!(
                mode.is_ok_and(|mode| mode & 0o111 != 0),
                "{name}: {command}"
            );
        }
    }
    assert_eq!(commands, 10);
    let release = read(".github/workflows/release.yml");
    let platforms = read("build.rs").matches("target: [\"").count();
    let is_known =
        |system, arch| read("build.rs").contains(&format!("target: [\"{system}\", \"{arch}\"]"));
    let targets: Vec<&str> = release
        .lines()
        .filter_map(|line| line.split_once("target: ")?.1.strip_suffix(" }"))
        .collect();
    assert_eq!(targets.len(), platforms);
    for target in targets {
        let system = if target.ends_with("-apple-darwin") {
            "macos"
        } else {
            "linux"
        };
        assert!(
            is_known(system, target.split('-').next().unwrap()),
            "{target}"
        );
    }
}
