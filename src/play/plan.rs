//! What the options of `play` ask for.

use std::path::PathBuf;

use clap::Error;

use crate::cli::{Made, PlayArgs, expect_together, usage_error};
use crate::os::Destination;
use crate::robustness::TableOutput;
use crate::sim::{Look, Quality};

/// What to do.
pub enum Plan {
    /// Play in a window.
    #[cfg_attr(
        not(feature = "viewer"),
        expect(dead_code, reason = "a build without windows refuses them")
    )]
    Window(Look),
    /// Play at this port for a browser.
    Web(u16, Look),
    /// Play for a score.
    Score(Outputs),
    /// Play for scores under changes.
    Robustness(TableOutput),
    /// Write the page of the trace in this file.
    Replay(PathBuf, Destination, Look),
}

/// What comes out of playing for a score.
pub struct Outputs {
    pub film: Option<Destination>,
    pub page: Option<Destination>,
    pub trace: Option<Destination>,
    /// What is seen in film and page.
    pub shot: Look,
    /// The frames of the film per second of simulated time.
    #[cfg_attr(
        not(feature = "video"),
        allow(dead_code, reason = "a build without films refuses them")
    )]
    pub fps: u32,
    /// Whether the score is printed as JSON.
    pub json: bool,
}

impl Plan {
    /// Plans what the options ask for. Without any, the episodes are played in a window where one can be opened.
    ///
    /// # Errors
    /// Fails with a usage error if the options do not go together.
    pub fn of(args: &PlayArgs, opens_windows: bool) -> Result<Self, Error> {
        let picture = only(&args.out, "pictures of a table", &["svg", "png"])?;
        let outputs = Outputs::of(args)?;
        let (plan, made) = match (&args.from_trace, &outputs.page, args.shot.web) {
            (Some(trace), Some(page), _) => (
                Self::Replay(trace.clone(), page.clone(), outputs.shot),
                vec![Made::Replay],
            ),
            _ if args.robustness => (
                Self::Robustness(TableOutput {
                    picture,
                    json: args.json,
                }),
                vec![Made::Robustness],
            ),
            (_, _, Some(port)) => (Self::Web(port, outputs.shot), vec![Made::Web]),
            _ if !args.wants_result() && (args.window || opens_windows) => (
                Self::Window(shot(args, [1280, 720], Quality::High)),
                vec![Made::Window],
            ),
            _ => {
                let mut made = vec![Made::Score];
                made.extend(outputs.film.iter().map(|_| Made::Picture));
                made.extend(outputs.page.iter().map(|_| Made::Page));
                (Self::Score(outputs), made)
            }
        };
        let mut given = args.given.clone();
        given.extend(
            args.out
                .iter()
                .map(|to| format!("--out FILE.{}", to.ending)),
        );
        expect_together(&made, &given).map_err(|text| usage_error("play", &text))?;
        Ok(plan)
    }
}

impl Outputs {
    /// Takes the outputs from the options.
    ///
    /// # Errors
    /// Fails with a usage error if two are of one kind.
    pub fn of(args: &PlayArgs) -> Result<Self, Error> {
        Ok(Self {
            film: only(&args.out, "films", &["mp4", "gif"])?,
            page: only(&args.out, "HTML files", &["html"])?,
            trace: only(&args.out, "traces", &["jsonl"])?,
            // A page has the size of its window.
            shot: shot(args, [640, 480], Quality::Fast),
            fps: args.fps,
            json: args.json,
        })
    }
}

/// What is seen, with this size and quality unless the user says others.
fn shot(args: &PlayArgs, size: [u32; 2], quality: Quality) -> Look {
    args.shot
        .sized(args.size.unwrap_or(size), args.quality.unwrap_or(quality))
}

/// The destination with one of these endings.
///
/// # Errors
/// Fails if there are two.
fn only(out: &[Destination], kind: &str, endings: &[&str]) -> Result<Option<Destination>, Error> {
    let mut found = out.iter().filter(|to| endings.contains(&to.ending));
    let one = found.next();
    if let Some((one, other)) = one.zip(found.next()) {
        let [one, other] = [one, other].map(|to| to.path.display());
        return Err(usage_error(
            "play",
            &format!("--out {one} --out {other}: of {kind}, one is written"),
        ));
    }
    Ok(one.cloned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::{Command, parse_from};

    /// The plan of these options, where no window can be opened.
    fn plan(options: &str) -> Result<Plan, String> {
        let words = ["shadow-repose", "play"]
            .into_iter()
            .chain(options.split_whitespace());
        let Command::Play(args) = parse_from(words).unwrap().command else {
            panic!("it plays")
        };
        Plan::of(&args, false).map_err(|error| error.to_string())
    }

    #[test]
    fn what_is_asked_for_decides_how_to_play() {
        let way = |options: &str| plan(options).unwrap();
        assert!(matches!(
            way(""),
            Plan::Score(Outputs {
                film: None,
                page: None,
                trace: None,
                json: false,
                ..
            })
        ));
        assert!(matches!(way("--window"), Plan::Window(_)));
        assert!(matches!(way("--web --hands 3"), Plan::Web(7070, _)));
        let report = way("--robustness --out x.svg --json");
        assert!(matches!(
            report,
            Plan::Robustness(TableOutput {
                picture: Some(_),
                json: true
            })
        ));
        assert!(matches!(
            way("--from-trace t --out x.html"),
            Plan::Replay(..)
        ));
        let all = way("--out a.gif --out b.html --out jsonl:c --json --fps 20 --size 64x32");
        let Plan::Score(outputs) = all else {
            panic!("a score")
        };
        assert_eq!(
            (outputs.fps, outputs.shot.size, outputs.film.unwrap().ending),
            (20, [64, 32], "gif")
        );
        assert_eq!(outputs.trace.unwrap().path, PathBuf::from("c"));
    }

    #[test]
    fn an_option_that_would_have_no_effect_is_refused_with_what_it_applies_to() {
        for (options, expected) in [
            (
                "--window --json",
                "--window cannot be used with a score; it applies only to a window",
            ),
            (
                "--web --headless",
                "--headless cannot be used with a page in a browser (--web)",
            ),
            (
                "--web --out x.gif",
                "--out FILE.gif cannot be used with a page in a browser",
            ),
            (
                "--out x.mp4 --window",
                "--window cannot be used with a score and a film or a picture (--out)",
            ),
            (
                "--out x.html --fps 20",
                "--fps cannot be used with a score and an HTML file (--out)",
            ),
            (
                "--out x.svg",
                "--out FILE.svg cannot be used with a score; it applies only to --robustness",
            ),
            (
                "--robustness --out x.jsonl",
                "--out FILE.jsonl cannot be used with --robustness",
            ),
            ("--json --plain", "--plain cannot be used with a score"),
            (
                "--headless --size 64x64",
                "it applies only to a film or a picture (--out)",
            ),
            (
                "--web-host hub.example",
                "it applies only to a page in a browser (--web)",
            ),
            (
                "--hands 1",
                "it applies only to a page in a browser (--web)",
            ),
            (
                "--from-trace t",
                "--from-trace cannot be used with a score; it applies only to an HTML file of a trace (--from-trace, --out FILE.html)",
            ),
            (
                "--from-trace t --out x.html --episodes 3",
                "--episodes cannot be used with an HTML file of a trace (--from-trace, --out FILE.html); it applies only to a window",
            ),
            (
                "--from-trace t --out x.html --seed 0",
                "--seed cannot be used with an HTML file of a trace",
            ),
            (
                "--out a.gif --out b.mp4",
                "--out a.gif --out b.mp4: of films, one is written",
            ),
        ] {
            let refused = plan(options).err().expect(options);
            assert!(refused.contains(expected), "{options}: {refused}");
        }
    }
}
