//! Where the user wants a file, and what it is to be.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// A file to write, as a user names it: by its path, or by an ending and a path that has none, such as `gif:/dev/stdout`.
#[derive(Clone, Debug)]
pub struct Destination {
    /// The ending, which says what kind of file it is.
    pub ending: &'static str,
    /// Where it is written.
    pub path: PathBuf,
}

impl Destination {
    /// Reads a name with one of these endings.
    ///
    /// # Errors
    /// Fails with the endings if it has another.
    pub fn parse(name: OsString, endings: &[&'static str]) -> Result<Self, String> {
        let known = |text: &str| {
            endings
                .iter()
                .copied()
                .find(|ending| ending.eq_ignore_ascii_case(text))
        };
        if let Some((begin, path)) = name.to_str().and_then(|name| name.split_once(':'))
            && let Some(ending) = known(begin)
            && !path.is_empty()
        {
            return Ok(Self {
                ending,
                path: path.into(),
            });
        }
        // A trace may be compressed.
        let packed = name.to_str().and_then(|name| name.strip_suffix(".gz"));
        let plain = packed.filter(|name| name.ends_with(".jsonl"));
        let extension = plain
            .map_or(Path::new(&name), Path::new)
            .extension()
            .and_then(|extension| extension.to_str());
        match extension.and_then(known) {
            Some(ending) => Ok(Self {
                ending,
                path: name.into(),
            }),
            None => {
                let all = endings.join(" or .");
                Err(format!(
                    "it must end in .{all}; {}:FILE names the kind of a file without an ending",
                    endings[0]
                ))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_says_what_the_file_is_by_its_ending_or_in_front_of_a_colon() {
        let parse = |name: &str| Destination::parse(name.into(), &["html", "jsonl"]);
        let found = |name: &str| {
            parse(name)
                .map(|to| (to.ending, to.path.display().to_string()))
                .unwrap()
        };
        assert_eq!(found("a/b.HTML"), ("html", "a/b.HTML".into()));
        assert_eq!(found("x.jsonl.gz"), ("jsonl", "x.jsonl.gz".into()));
        assert_eq!(found("jsonl:/dev/stdout"), ("jsonl", "/dev/stdout".into()));
        assert_eq!(found("./jsonl:x.html"), ("html", "./jsonl:x.html".into()));
        for name in [
            "x",
            "x.gif",
            "x.html.gz",
            "gif:x",
            "jsonl",
            "jsonl:",
            ".html",
        ] {
            let refused = "it must end in .html or .jsonl; html:FILE names the kind of a file without an ending";
            assert_eq!(parse(name).unwrap_err(), refused, "{name}");
        }
    }
}
