//! Which options of `play` and `view` go together: each goes with something that is made.

use clap::ArgMatches;
use clap::parser::ValueSource;

/// Something that `play` or `view` makes.
#[derive(Clone, Copy, PartialEq)]
pub enum Made {
    /// A window.
    Window,
    /// A page in a browser.
    Web,
    /// A score over whole episodes, and a trace of them.
    Score,
    /// The table of scores under changes.
    Robustness,
    /// A film or a picture.
    Picture,
    /// An HTML file of what is played.
    Page,
    /// An HTML file of a trace.
    Replay,
    /// The check of a hand.
    Check,
}

/// What is made, its name, and the options that go with it. An option in no row goes with everything.
const GO_WITH: [Row; 8] = [
    (
        Made::Window,
        "a window",
        "--window, --ckpt, --stochastic, --episodes, --seed, --threads, --camera, --quality, --plain",
    ),
    (
        Made::Web,
        "a page in a browser (--web)",
        "--web, --web-host, --hands, --follow, --ckpt, --stochastic, --seed, --threads, --camera, --plain",
    ),
    (
        Made::Score,
        "a score",
        "--headless, --json, --out FILE.jsonl, --ckpt, --stochastic, --episodes, --seed, --threads",
    ),
    (
        Made::Robustness,
        "--robustness",
        "--robustness, --headless, --json, --out FILE.svg, --out FILE.png, --ckpt, --stochastic, --episodes, --seed, --threads",
    ),
    (
        Made::Picture,
        "a film or a picture (--out)",
        "--out FILE.mp4, --out FILE.gif, --fps, --at, --seed, --size, --camera, --quality, --plain",
    ),
    (
        Made::Page,
        "an HTML file (--out)",
        "--out FILE.html, --camera, --plain",
    ),
    (
        Made::Replay,
        "an HTML file of a trace (--from-trace, --out FILE.html)",
        "--from-trace, --out FILE.html, --camera, --plain",
    ),
    (Made::Check, "a check of the hand (--check)", "--check"),
];

type Row = (Made, &'static str, &'static str);

/// Checks that each of the options `given` goes with something that is `made`.
///
/// # Errors
/// Fails with a sentence that says what the option goes with.
pub fn expect_together(made: &[Made], given: &[String]) -> Result<(), String> {
    let rows = |of: &dyn Fn(&Row) -> bool| -> Vec<Row> { GO_WITH.into_iter().filter(of).collect() };
    let names = |rows: &[Row]| Vec::from_iter(rows.iter().map(|(_, name, _)| *name));
    let is_made = |(row, ..): &Row| made.contains(row);
    for option in given {
        let takers = rows(&|(.., options)| options.split(", ").any(|known| known == option));
        if !takers.is_empty() && !takers.iter().any(is_made) {
            return Err(format!(
                "{option} cannot be used with {}; it applies only to {}",
                names(&rows(&is_made)).join(" and "),
                names(&takers).join(" or ")
            ));
        }
    }
    Ok(())
}

/// The options of the command that stand on the command line, without those that have their defaults.
pub fn given(matches: &ArgMatches) -> Vec<String> {
    let Some((_, of_command)) = matches.subcommand() else {
        return Vec::new();
    };
    let ids = of_command.ids().map(clap::Id::as_str);
    ids.filter(|id| of_command.value_source(id) == Some(ValueSource::CommandLine))
        .map(|id| format!("--{}", id.replace('_', "-")))
        .collect()
}
