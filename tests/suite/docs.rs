//! The documents: what they repeat of the program is true, their links lead somewhere, their lines can be read in a diff.

use std::fs;
use std::path::{Path, PathBuf};

use shadow_repose::repose::{ACTUATORS, FINGERTIPS, Group, JOINTS, OBSERVATION};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(name: &str) -> String {
    fs::read_to_string(root().join(name)).unwrap()
}

/// Returns the documents that people read: those of the root and of docs/, without the notes in docs/log/.
fn documents() -> Vec<PathBuf> {
    let is_document = |path: &PathBuf| path.extension().is_some_and(|kind| kind == "md");
    let folders = [root().to_owned(), root().join("docs")];
    let found: Vec<PathBuf> = folders
        .iter()
        .flat_map(|folder| fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()))
        .filter(is_document)
        .collect();
    assert!(found.len() > 7, "{found:?}");
    found
}

#[test]
fn the_table_of_the_observation_is_the_one_of_the_program() {
    let text = read("docs/OBSERVATION.md");
    for Group { name, start, length, unit } in OBSERVATION {
        let row = format!("| {start} … {} | `{name}` | {length} | {unit} |", start + length - 1);
        assert!(text.contains(&row), "{row}");
    }
    assert_eq!(text.lines().filter(|line| line.contains(" … ") && line.starts_with("| ")).count(), OBSERVATION.len());
    for (what, names) in [("joints", &JOINTS[..]), ("actuators", &ACTUATORS), ("fingertips", &FINGERTIPS)] {
        let row = format!("| {what} | {} |", names.join(" "));
        assert!(text.contains(&row), "{row}");
    }
}

#[test]
fn scores_in_the_readme_are_those_of_the_results() {
    let (readme, results) = (read("README.md"), read("docs/RESULTS.md"));
    let rows = readme.lines().filter(|line| line.starts_with("| ") && line.contains(|c: char| c.is_ascii_digit()));
    let rows: Vec<&str> = rows.filter(|row| !row.contains("| `")).collect();
    assert!(rows.len() >= 8, "{rows:?}");
    for row in rows {
        assert!(results.lines().any(|line| line.trim() == row), "docs/RESULTS.md lacks the row {row}");
    }
}

#[test]
fn the_readme_is_short_and_names_the_test_command() {
    let readme = read("README.md");
    assert!(readme.lines().count() <= 150);
    assert!(readme.contains("cargo test --release"));
    assert!(read("docs/LEARNING.md").lines().count() <= 200);
}

#[test]
fn lines_of_documents_are_short_but_for_tables_and_addresses() {
    for path in documents() {
        for (number, line) in fs::read_to_string(&path).unwrap().lines().enumerate() {
            let may_be_long = line.trim_start().starts_with('|') || line.contains("https://");
            let length = line.chars().count();
            assert!(may_be_long || length <= 140, "{}:{}: {length} characters", path.display(), number + 1);
        }
    }
}

#[test]
fn relative_links_lead_to_files_and_headings() {
    for path in documents().into_iter().chain(super::architecture::sources(&root().join("docs/log"))) {
        if path.extension().is_none_or(|kind| kind != "md") {
            continue;
        }
        let text = fs::read_to_string(&path).unwrap();
        for link in text.split("](").skip(1).map(|rest| rest.split(')').next().unwrap()) {
            if link.starts_with("https://") {
                continue;
            }
            let (file, heading) = link.split_once('#').unwrap_or((link, ""));
            let target = if file.is_empty() { path.clone() } else { path.parent().unwrap().join(file) };
            assert!(target.exists(), "{}: {link}", path.display());
            if !heading.is_empty() {
                let text = fs::read_to_string(&target).unwrap();
                let headings = text.lines().filter(|line| line.starts_with('#')).map(anchor);
                assert!(headings.into_iter().any(|found| found == heading), "{}: {link}", path.display());
            }
        }
    }
}

/// Returns the anchor of a heading, as GitHub makes it.
fn anchor(heading: &str) -> String {
    let text = heading.trim_start_matches('#').trim().to_lowercase();
    let kept = text.chars().filter(|c| c.is_alphanumeric() || "-_ ".contains(*c));
    kept.map(|c| if c == ' ' { '-' } else { c }).collect()
}

#[test]
fn every_setting_and_option_that_the_documents_name_exists() {
    let settings = include_str!("../../configs/repose.toml");
    let mut help = String::new();
    for command in shadow_repose::cli::command().get_subcommands_mut() {
        help += &command.render_long_help().to_string();
    }
    for path in documents().into_iter().filter(|path| !path.ends_with("CHANGELOG.md")) {
        let text = fs::read_to_string(&path).unwrap();
        for word in text.split(|c: char| c.is_whitespace() || "`(),:;|\"'".contains(c)) {
            let word = word.split('=').next().unwrap().trim_end_matches('.');
            let section =
                word.split_once('.').filter(|(section, _)| ["env", "training", "ppo", "run"].contains(section));
            if let Some((_, key)) = section.filter(|(_, key)| !key.is_empty() && *key != "…") {
                let key = key.split('.').next().unwrap();
                let is_known = settings.lines().any(|line| line.split(" =").next() == Some(key));
                let stands_for_some = key.contains('…') || key.contains('*') || ["KEY", "lock"].contains(&key);
                assert!(is_known || stands_for_some, "{}: {word}", path.display());
            }
            if word.starts_with("--") && word.len() > 3 && text.contains("shadow-repose") {
                const OF_OTHERS: [&str; 21] = [
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
                ];
                let of_others = OF_OTHERS.contains(&word) || word.starts_with("--cpus") || word.starts_with("---");
                assert!(of_others || help.contains(word), "{}: {word}", path.display());
            }
        }
    }
}

/// The goals of the evaluations that are nearest to these steps, by both commands of the built-in policy.
#[test]
fn goals_by_time_are_those_of_the_tables() {
    let results = read("docs/RESULTS.md");
    let tables = [("## By time", "default", 0..3, 21_500.0), ("\nThe second command,", "continue", 0..1, 19_900.0)];
    for (title, runs, seeds, steps_per_s) in tables {
        let by_time = results.split(title).nth(1).unwrap();
        let cells = |start: &str| -> Vec<String> {
            let row = by_time.lines().find_map(|line| line.strip_prefix(start)).unwrap();
            row.trim_matches(['|', ' ']).split('|').map(|cell| cell.trim().to_owned()).collect()
        };
        let steps: Vec<f64> =
            cells("| steps |").iter().map(|cell| cell.trim_end_matches(" M").parse().unwrap()).collect();
        let minutes = steps.iter().map(|at| (at * 1e6 / steps_per_s / 60.0).round());
        let shown: Vec<f64> = cells("| minutes |").iter().map(|cell| cell.parse().unwrap()).collect();
        assert!(minutes.zip(&shown).all(|(expected, shown)| (expected - shown).abs() <= 1.0), "{title}: {shown:?}");
        for seed in seeds {
            let evaluations = evaluations(&format!("docs/metrics/{runs}-{seed}/metrics.csv"));
            let nearest = |at: f64| {
                let distance = |of: &(f64, f64)| (of.0 - at).abs();
                evaluations.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap().1
            };
            let row = cells(&format!("| goals, seed {seed} |"));
            // A cell is left out only where the run had ended.
            let last = evaluations.last().unwrap().0;
            let expected = steps.iter().filter(|at| **at < last + 1.0).map(|at| format!("{:.1}", nearest(*at)));
            let expected: Vec<String> = expected.collect();
            assert_eq!(row, expected, "{title}: seed {seed}");
        }
    }
}

/// Returns the evaluations in a table of a training: millions of steps, and goals per episode.
fn evaluations(path: &str) -> Vec<(f64, f64)> {
    let table = read(path);
    let mut lines = table.lines().map(|line| line.split(',').collect::<Vec<&str>>());
    let header = lines.next().unwrap();
    let [env_steps, goals] =
        ["env_steps", "eval/goals"].map(|name| header.iter().position(|column| *column == name).unwrap());
    lines.filter_map(|row| Some((row[env_steps].parse::<f64>().unwrap() / 1e6, row[goals].parse().ok()?))).collect()
}
