//! The values of options as a user writes them.

use std::time::Duration;

use clap::builder::{
    OsStringValueParser, PossibleValuesParser, RangedU64ValueParser, TypedValueParser,
};

use crate::os::Destination;
use crate::sim::{Camera, Quality};

/// The largest integer in a TOML file.
const LARGEST: u64 = i64::MAX as u64;

pub fn seed() -> RangedU64ValueParser {
    RangedU64ValueParser::new().range(..=LARGEST)
}

pub fn count() -> RangedU64ValueParser<usize> {
    RangedU64ValueParser::new().range(1..=1_000_000)
}

/// A number of threads, within the limits of `run.threads`.
pub fn threads() -> RangedU64ValueParser<usize> {
    RangedU64ValueParser::new().range(0..=4096)
}

pub fn size(text: &str) -> Result<[u32; 2], String> {
    let (width, height) = text
        .split_once('x')
        .ok_or("must be WIDTHxHEIGHT, e.g. 640x480")?;
    let pixels = |text: &str, largest: u32| match text.parse() {
        Ok(pixels) if (16..=largest).contains(&pixels) => Ok(pixels),
        _ => Err(format!(
            "{text} must be a whole number from 16 to {largest}"
        )),
    };
    Ok([pixels(width, 3840)?, pixels(height, 2160)?])
}

pub fn camera(text: &str) -> Result<Camera, String> {
    let numbers: Result<Vec<f64>, _> = text
        .split(',')
        .map(|number| number.trim().parse())
        .collect();
    match numbers.as_deref() {
        Ok(&[azimuth, elevation, distance]) if azimuth.is_finite() && elevation.is_finite() => {
            match (0.05..=10.0).contains(&distance) {
                true => Ok(Camera {
                    azimuth,
                    elevation,
                    distance,
                }),
                false => Err(format!(
                    "the distance of {distance} m must be from 0.05 to 10 m"
                )),
            }
        }
        _ => Err("must be three numbers, e.g. 150,-27,0.66".into()),
    }
}

pub fn steps(text: &str) -> Result<u64, String> {
    // Users write large numbers of steps as 1e8.
    let float = text
        .parse::<f64>()
        .ok()
        .filter(|x| x.fract() == 0.0 && (0.0..9e15).contains(x))
        .map(|x| x as u64);
    let steps = text
        .parse()
        .ok()
        .or(float)
        .filter(|steps| (1..=LARGEST).contains(steps));
    steps.ok_or_else(|| "must be a whole number of at least 1, e.g. 30000000 or 3e7".into())
}

pub fn time(text: &str) -> Result<Duration, String> {
    // Slurm writes days before a hyphen: 1-12:00:00.
    let days = text.split_once('-').filter(|(_, rest)| rest.contains(':'));
    let text = days.map_or(text.into(), |(days, rest)| format!("{days}d {rest}"));
    let span = text.parse::<jiff::Span>().ok();
    let time = span
        .and_then(|span| {
            span.to_duration(jiff::SpanRelativeTo::days_are_24_hours())
                .ok()
        })
        .and_then(|time| Duration::try_from(time).ok());
    time.filter(|time| !time.is_zero())
        .ok_or_else(|| "must be a time above 0, e.g. 2d, 3h50m, 90m, 30s or 1-12:00:00".into())
}

pub fn host(text: &str) -> Result<String, String> {
    let is_foreign = |c: char| !c.is_ascii_alphanumeric() && !"-._".contains(c);
    if text.is_empty() || text.contains(is_foreign) {
        return Err("must be a host name without a port, such as hub.example.org".into());
    }
    Ok(text.into())
}

pub fn quality() -> impl TypedValueParser<Value = Quality> {
    // Shells complete them.
    PossibleValuesParser::new(["fast", "high"]).map(|text| {
        if text == "fast" {
            Quality::Fast
        } else {
            Quality::High
        }
    })
}

pub fn destination(endings: &'static [&'static str]) -> impl TypedValueParser<Value = Destination> {
    OsStringValueParser::new().try_map(|name| Destination::parse(name, endings))
}

pub fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text
        .parse()
        .ok()
        .filter(|seconds| (0.0..=3600.0).contains(seconds));
    seconds.ok_or_else(|| "must be a number of seconds from 0 to 3600".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_has_the_units_of_a_user_or_the_form_of_slurm() {
        let hours = |text: &str| time(text).ok().map(|time| time.as_secs_f64() / 3600.0);
        for (text, expected) in [
            ("2d", 48.0),
            ("1-00:00:00", 24.0),
            ("1-12:30:00", 36.5),
            ("3h50m", 3.0 + 5.0 / 6.0),
            ("90m", 1.5),
        ] {
            assert_eq!(hours(text), Some(expected), "{text}");
        }
        for text in ["", "0s", "-5s", "soon", "1-2-3", "1mo"] {
            assert_eq!(hours(text), None, "{text}");
        }
    }
}
