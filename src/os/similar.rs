//! Suggestions for names that were mistyped.

/// The maximum length of a name that is compared with the known ones: the comparison takes quadratic time.
const LONGEST: usize = 64;

/// The known names that are like `name`, the nearest first. Names have parts, divided by `separator`.
pub fn similar<'a>(
    name: &str,
    known: impl Iterator<Item = &'a str>,
    separator: char,
) -> Vec<&'a str> {
    if name.len() > LONGEST {
        return Vec::new();
    }
    let last = |s: &str| s.rsplit(separator).next().unwrap_or_default().to_owned();
    let distance = |candidate: &str| {
        let whole = strsim::damerau_levenshtein(name, candidate);
        // The right last part behind a wrong first one counts as one wrong letter.
        whole.min(1 + strsim::damerau_levenshtein(&last(name), &last(candidate)))
    };
    let mut alike: Vec<(usize, &str)> = known
        .map(|candidate| (distance(candidate), candidate))
        .collect();
    alike.retain(|(distance, _)| *distance <= 2 + name.len() / 4);
    alike.sort_by_key(|(distance, _)| *distance);
    // Names much farther away than the nearest one are left out.
    let nearest = alike.first().map_or(0, |(distance, _)| *distance);
    alike.retain(|(distance, _)| *distance <= nearest + 1);
    alike.into_iter().map(|(_, candidate)| candidate).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_name_comes_first_and_unlike_ones_do_not_come() {
        let known = ["episode/goals", "eval/goals", "loss/value", "loss/policy"];
        assert_eq!(
            similar("eval/goal", known.into_iter(), '/')[0],
            "eval/goals"
        );
        assert_eq!(
            similar("goals", known.into_iter(), '/'),
            ["episode/goals", "eval/goals"]
        );
        assert_eq!(
            similar("loss/vaule", known.into_iter().chain(["reward/fall"]), '/'),
            ["loss/value"]
        );
        assert!(similar(&"goals".repeat(50), known.into_iter(), '/').is_empty());
    }
}
