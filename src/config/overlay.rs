//! Overlays one table of settings with another. Keys and types come from the base, and what does not fit is reported.

use std::path::Path;
use std::sync::LazyLock;

use toml::Value::{Array, Float, Integer};
use toml::{Table, Value};

use super::BASE;
use crate::os::{shortened, similar};

/// The base as tables.
pub static DEFAULTS: LazyLock<Table> =
    LazyLock::new(|| BASE.parse().expect("the built-in configuration is TOML"));

/// The settings of all sections of a table, each with its dotted key.
pub fn settings(table: &Table) -> impl Iterator<Item = (String, &Value)> {
    table.iter().flat_map(|(section, keys)| {
        let keys = keys.as_table().into_iter().flatten();
        keys.map(move |(key, value)| (format!("{section}.{key}"), value))
    })
}

/// The value with this dotted key.
pub fn lookup<'a>(table: &'a Table, key: &str) -> Option<&'a Value> {
    let (section, rest) = key.split_once('.').unwrap_or((key, ""));
    rest.split_terminator('.')
        .try_fold(table.get(section)?, |value, part| value.get(part))
}

/// A number, whole or not.
pub fn number(value: &Value) -> Option<f64> {
    value.as_float().or(value.as_integer().map(|x| x as f64))
}

/// A number as text: `1e300` rather than 301 digits.
pub fn brief(x: f64) -> String {
    let text = x.to_string();
    if text.len() > 20 {
        format!("{x:e}")
    } else {
        text
    }
}

/// A value as it stands in an error message.
pub fn shown(value: &Value) -> String {
    match value {
        Float(x) if x.is_finite() => brief(*x),
        value => value.to_string(),
    }
}

/// Whether a table of the base is a ramp, rather than a section or values by group.
pub fn is_ramp(table: &Table) -> bool {
    table.contains_key("from")
}

/// The table that sets this one value over `merged`. Text that is not a TOML value becomes a string, as does any text
/// for a string key. Numbers may lack the zero before their point, which TOML requires.
pub fn table_of(key: &str, text: &str, merged: &Table) -> Table {
    let parse = |text: &str| {
        let mut table: Table = format!("value = {text}").parse().ok()?;
        table.remove("value").filter(|_| table.is_empty())
    };
    let wants_text = lookup(&DEFAULTS, key).is_some_and(Value::is_str);
    let mut value = match parse(text).or_else(|| parse(&with_zeros(text))) {
        Some(value) if !wants_text || value.is_str() => value,
        _ => text.into(),
    };
    // The deepest level is a part of a ramp in a section. Anything deeper belongs to an unknown name.
    let parts: Vec<&str> = key.splitn(3, '.').collect();
    for depth in (1..parts.len()).rev() {
        let whole = parts[..depth].join(".");
        // `env.noise.joint_pos` changes one value of `env.noise`, so the other values are copied.
        let inside = |of| lookup(of, &whole).and_then(Value::as_table);
        let others = inside(merged).filter(|_| inside(&DEFAULTS).is_some_and(Table::is_empty));
        let mut table = others.cloned().unwrap_or_default();
        table.insert(parts[depth].to_owned(), value);
        value = table.into();
    }
    Table::from_iter([(parts[0].to_owned(), value)])
}

/// The text with a zero before each point that begins a number: `[0.5,-0.1]` for `[.5,-.1]`.
fn with_zeros(text: &str) -> String {
    let bytes = text.as_bytes();
    let begins = |i: usize| {
        let joined = i > 0 && bytes[i - 1].is_ascii_alphanumeric();
        bytes[i] == b'.' && !joined && bytes.get(i + 1).is_some_and(u8::is_ascii_digit)
    };
    let mut filled = text.to_owned();
    for i in (0..bytes.len()).rev().filter(|&i| begins(i)) {
        filled.insert(i, '0');
    }
    filled
}

/// Whether a value of `env.model` names `stored`: the built-in scene, or the scene at this absolute path.
pub fn names_scene(asked: &Value, stored: &str) -> bool {
    asked.as_str().is_some_and(|asked| {
        let file = Path::new(asked).canonicalize();
        asked == stored || file.is_ok_and(|file| file == Path::new(stored))
    })
}

/// The maximum number of problems to report. The first ones are enough to start with.
const MOST_PROBLEMS: usize = 30;

/// Applies `table` over `merged`, which has the keys and types of `base`. What does not fit is skipped and reported.
pub fn overlay(
    merged: &mut Table,
    table: &Table,
    base: &Table,
    prefix: &str,
    problems: &mut Vec<String>,
) {
    for (key, value) in table {
        if problems.len() >= MOST_PROBLEMS {
            return;
        }
        let name = format!("{prefix}{key}");
        let Some(expected) = base.get(key) else {
            problems.push(unknown(&name));
            continue;
        };
        if let Value::Table(expected) = expected
            && let Some(given) = inner(expected, value)
        {
            let mut expected = expected.clone();
            if is_ramp(&expected) {
                expected.insert("after".into(), 0.into());
            } else if expected.is_empty() {
                // Values by group replace all earlier ones. The names of the groups are checked elsewhere.
                merged[key] = Table::new().into();
                expected = given
                    .keys()
                    .map(|name| (name.clone(), 0.0.into()))
                    .collect();
            }
            let target = merged[key]
                .as_table_mut()
                .expect("the merged tables are those of the base");
            let parts = format!("{name}.");
            overlay(target, &given, &expected, &parts, problems);
            // The remaining parts alone are not the ramp that the user wrote, so no other rule is applied to them.
            if is_ramp(&expected) && problems.iter().any(|problem| problem.starts_with(&parts)) {
                merged[key] = base[key].clone();
            }
            continue;
        }
        match typed(expected, value) {
            Ok(value) => drop(merged.insert(key.clone(), value)),
            Err(rule) => {
                problems.push(format!(
                    "{} = {}: must be {rule}",
                    shortened(&name),
                    shortened(&shown(value))
                ));
            }
        }
    }
}

/// What a value sets in a table of the base, if it fits: a plain number in place of a ramp is a constant.
fn inner(expected: &Table, value: &Value) -> Option<Table> {
    let mut given = if is_ramp(expected) && number(value).is_some() {
        let parts = [
            ("from", value.clone()),
            ("to", value.clone()),
            ("steps", 0.into()),
        ];
        Table::from_iter(parts.map(|(part, value)| (part.to_owned(), value)))
    } else {
        value.as_table()?.clone()
    };
    // A complete ramp without `after` starts at step 0, even if the default has an `after`. `to_text` relies on this.
    if is_ramp(expected)
        && ["from", "to", "steps"]
            .iter()
            .all(|part| given.contains_key(*part))
    {
        given.entry("after").or_insert(0.into());
    }
    Some(given)
}

/// Converts `value` to the type of the base's value. The error describes that type.
fn typed(expected: &Value, value: &Value) -> Result<Value, String> {
    match (expected, value) {
        (Float(_), Float(x)) if !x.is_finite() => Err("a finite number".into()),
        (Float(_), Float(_)) | (Value::String(_), Value::String(_)) => Ok(value.clone()),
        (Float(_), Integer(i)) => Ok(Float(*i as f64)),
        (Integer(_), Integer(i)) if *i >= 0 => Ok(value.clone()),
        // Users write large numbers of steps as 1e8.
        (Integer(_), Float(x)) if x.fract() == 0.0 && (0.0..9e15).contains(x) => {
            Ok(Integer(*x as i64))
        }
        (Array(expected), Array(values)) => {
            // An empty list is a list of names.
            let one = expected.first().cloned().unwrap_or("".into());
            let typed: Result<_, _> = values.iter().map(|value| typed(&one, value)).collect();
            typed
                .map(Array)
                .map_err(|rule| format!("an array of values that are each {rule}"))
        }
        _ => Err(type_of(expected)),
    }
}

/// What a value in the place of this one must be.
fn type_of(expected: &Value) -> String {
    let text = match expected {
        Float(_) => "a number",
        Integer(_) => "a whole number, not negative",
        Value::String(_) => "a string",
        Array(_) => return format!("an array, e.g. {expected}"),
        Value::Table(table) if is_ramp(table) => {
            "a number, or { from = …, to = …, steps = …, after = … }"
        }
        Value::Table(table) if table.is_empty() => {
            "a table of numbers by name, e.g. { joint_pos = 0.01 }"
        }
        _ => "a section with keys",
    };
    text.into()
}

fn unknown(name: &str) -> String {
    // Within a section that is known, or a ramp, only what belongs there is suggested.
    let (whole, last) = name.rsplit_once('.').unwrap_or(("", name));
    let known: Vec<String> = match lookup(&DEFAULTS, whole) {
        Some(Value::Table(inside)) => inside.keys().map(|key| format!("{whole}.{key}")).collect(),
        _ => {
            let sections = DEFAULTS.keys().filter(|_| whole.is_empty()).cloned();
            sections
                .chain(settings(&DEFAULTS).map(|(key, _)| key))
                .collect()
        }
    };
    let known = || known.iter().map(String::as_str);
    let end = |key: &str| key.rsplit('.').next().unwrap_or_default().to_owned();
    let is_near = |key: &&str| strsim::damerau_levenshtein(&end(key), last) <= 1 + last.len() / 4;
    let holds = |key: &&str| last.len() > 2 && end(key).contains(last);
    let initials = |key: &str| {
        end(key)
            .split('_')
            .filter_map(|word| word.chars().next())
            .collect::<String>()
    };
    let near = similar(name, known(), '.').into_iter().find(is_near);
    let near = near.or(known().find(holds));
    let hint = match near.or(known().find(|key| initials(key) == last)) {
        Some(nearest) => format!("did you mean {nearest}?"),
        None => "configs/repose.toml lists all of them".into(),
    };
    format!("{}: unknown key; {hint}", shortened(name))
}

#[cfg(test)]
mod tests {
    use crate::config::{Settings, Source};

    fn errors(sets: &[&str]) -> String {
        let sets: Vec<_> = sets.iter().map(|set| set.parse().unwrap()).collect();
        Settings::new()
            .sets(&sets)
            .resolve()
            .unwrap_err()
            .to_string()
    }

    #[test]
    fn a_table_that_is_no_toml_is_refused_with_an_example_and_in_a_file_with_the_reason() {
        let ramp = "must be a number, or { from = …";
        for (bad, rule) in [
            ("training.tolerance={from=1,from=2,to=1,steps=1}", ramp),
            ("training.tolerance={from=.1 to=.2}", ramp),
            (
                "env.noise={joint_pos=1,joint_pos=2}",
                "e.g. { joint_pos = 0.01 }",
            ),
        ] {
            let text = errors(&[bad]);
            assert!(text.contains(rule), "{bad}: {text}");
        }
        let file = Source::new("x.toml", "[training]\ntolerance = {from=1,from=2}");
        let file = Settings::new().file(file).resolve().unwrap_err();
        assert!(file.to_string().contains("duplicate key"), "{file}");
    }

    #[test]
    fn numbers_may_begin_with_their_point() {
        let sets = [
            "ppo.std=.27",
            "randomization.gains=[.7,1.6]",
            "training.tolerance={from=.4,to=.1,steps=9}",
        ];
        let sets = sets.into_iter().chain([
            "env.noise.joint_pos=.01",
            "training.drop_reward=-.5",
            "env.model=.5x",
        ]);
        let sets: Vec<_> = sets.map(|set| set.parse().unwrap()).collect();
        let config = Settings::new().sets(&sets).resolve().unwrap();
        assert_eq!(
            (config.ppo.std.0.to, config.training.drop_reward.to),
            (0.27, -0.5)
        );
        assert_eq!(
            (config.randomization.gains, config.training.tolerance.0.from),
            ([0.7, 1.6], 0.4)
        );
        assert_eq!(
            (config.env.noise["joint_pos"], config.env.model.as_str()),
            (0.01, ".5x")
        );
    }

    #[test]
    fn of_a_ramp_with_a_wrong_part_only_that_part_is_told() {
        for sets in [
            ["ppo.horizon.from=2.5", "ppo.horizon.to=5"],
            ["ppo.horizon.to=5", "ppo.horizon.from=2.5"],
        ] {
            let text = errors(&sets);
            assert_eq!(text.matches("\n  ").count(), 1, "{text}");
            assert!(
                text.contains("ppo.horizon.from = 2.5: must be a whole number"),
                "{text}"
            );
        }
    }

    #[test]
    fn a_huge_number_is_told_in_few_digits() {
        for (bad, told) in [
            (
                "training.tolerance.steps=1e300",
                "training.tolerance.steps = 1e300: must be a whole number",
            ),
            (
                "training.tolerance=-1e300",
                "training.tolerance = -1e300: must be above 0",
            ),
            (
                "env.rot_eps=1e300",
                "env.rot_eps = 1e300: must be at most 1000000000",
            ),
        ] {
            let text = errors(&[bad]);
            assert!(text.contains(told), "{bad}: {text}");
        }
    }
}
