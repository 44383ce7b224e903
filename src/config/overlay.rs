//! Overlaying one table of settings with another: keys and types are those of the base; what does not fit is reported.

use std::borrow::Cow;

use toml::{Table, Value};

use super::BASE;
use super::ramp::Ramp;
use crate::os::similar;

/// Returns the table with this one value. Text that is not a TOML value becomes a string, as does any text for a string key.
pub(super) fn table_of(key: &str, text: &str, base: &Table) -> Table {
    let parsed = format!("value = {text}").parse::<Table>();
    let parsed = parsed.ok().filter(|t| t.len() == 1).and_then(|mut t| t.remove("value"));
    let wants_text = lookup(base, key).is_some_and(Value::is_str);
    let mut value = match parsed {
        Some(value) if !wants_text || value.is_str() => value,
        _ => Value::String(text.to_owned()),
    };
    // The deepest level is a part of a ramp in a section; anything deeper belongs to an unknown name.
    let parts: Vec<&str> = key.splitn(3, '.').collect();
    for part in parts[1..].iter().rev() {
        value = Table::from_iter([((*part).to_owned(), value)]).into();
    }
    Table::from_iter([(parts[0].to_owned(), value)])
}

/// Returns `table`, which sets `key` alone, with the other values of the free table in which it is, if it is in one:
/// `env.noise.joint_pos` changes one value of `env.noise`.
pub(super) fn with_the_others(mut table: Table, key: &str, merged: &Table, base: &Table) -> Table {
    let whole = key.rsplit_once('.').map(|(whole, _)| whole);
    let of = |table: &Table| whole.and_then(|whole| lookup(table, whole)).and_then(Value::as_table).cloned();
    if of(base).is_some_and(|free| free.is_empty())
        && let (Some(others), Some((section, name))) = (of(merged), whole.and_then(|whole| whole.split_once('.')))
        && let Some(Value::Table(own)) = table.get_mut(section).and_then(|section| section.get_mut(name))
    {
        let given = std::mem::replace(own, others);
        own.extend(given);
    }
    table
}

fn lookup<'a>(table: &'a Table, key: &str) -> Option<&'a Value> {
    let (first, rest) = key.split_once('.').unwrap_or((key, ""));
    match (table.get(first)?, rest) {
        (value, "") => Some(value),
        (Value::Table(inner), rest) => lookup(inner, rest),
        _ => None,
    }
}

/// The maximum number of problems to report; the first ones are enough to start with.
const MOST_PROBLEMS: usize = 30;

/// Applies `table` over `merged`, whose keys and types are those of `base`; what does not fit is skipped and reported.
pub(super) fn overlay(merged: &mut Table, table: &Table, base: &Table, prefix: &str, problems: &mut Vec<String>) {
    for (key, value) in table {
        if problems.len() >= MOST_PROBLEMS {
            return;
        }
        let name = format!("{prefix}{key}");
        match (base.get(key), value) {
            (None, _) => problems.push(unknown(&name)),
            // A plain number in place of a ramp is a constant.
            (Some(expected), Value::Integer(_) | Value::Float(_)) if is_ramp(expected) => {
                let parts = ["from", "to"].map(|part| (part.to_owned(), value.clone()));
                let zeros = ["steps", AFTER].map(|part| (part.to_owned(), Value::Integer(0)));
                let constant = Table::from_iter(parts.into_iter().chain(zeros));
                overlay(merged, &Table::from_iter([(key.clone(), constant.into())]), base, prefix, problems);
            }
            // A table of values by names that are checked elsewhere replaces the one before.
            (Some(Value::Table(expected)), Value::Table(inner)) if expected.is_empty() => {
                let zeros = Table::from_iter(inner.keys().map(|name| (name.clone(), Value::Float(0.0))));
                merged.insert(key.clone(), Table::new().into());
                let Some(Value::Table(target)) = merged.get_mut(key) else {
                    unreachable!("the merged tables are those of the base")
                };
                overlay(target, inner, &zeros, &format!("{name}."), problems);
            }
            // A complete ramp without `after` starts at step 0, even if the default has an `after`; `to_text` relies on this.
            (Some(of), Value::Table(whole))
                if is_ramp(of)
                    && !whole.contains_key(AFTER)
                    && ["from", "to", "steps"].iter().all(|part| whole.contains_key(*part)) =>
            {
                let mut whole = whole.clone();
                whole.insert(AFTER.to_owned(), Value::Integer(0));
                overlay(merged, &Table::from_iter([(key.clone(), whole.into())]), base, prefix, problems);
            }
            (Some(of), Value::Table(inner)) if let Value::Table(expected) = with_all_parts(of).as_ref() => {
                let Some(Value::Table(target)) = merged.get_mut(key) else {
                    unreachable!("the merged tables are those of the base")
                };
                overlay(target, inner, expected, &format!("{name}."), problems);
            }
            (Some(expected), value) => match typed(expected, value) {
                Ok(value) => drop(merged.insert(key.clone(), value)),
                Err(rule) => problems.push(format!("{name} = {value}: must be {rule}")),
            },
        }
    }
}

/// The part of a ramp that the base may leave out.
const AFTER: &str = "after";

/// Returns a value of the base; a ramp with all its parts.
fn with_all_parts(base: &Value) -> Cow<'_, Value> {
    let mut base = Cow::Borrowed(base);
    if is_ramp(&base)
        && let Value::Table(ramp) = base.to_mut()
    {
        ramp.entry(AFTER).or_insert(Value::Integer(0));
    }
    base
}

/// Returns whether this value of the base is a ramp.
fn is_ramp(base: &Value) -> bool {
    base.clone().try_into::<Ramp>().is_ok()
}

/// Converts `value` to the type of the base's value, or returns a description of that type.
fn typed(expected: &Value, value: &Value) -> Result<Value, String> {
    match (expected, value) {
        (Value::Float(_), Value::Float(x)) if !x.is_finite() => Err("a finite number".into()),
        (Value::Float(_), Value::Float(_))
        | (Value::String(_), Value::String(_))
        | (Value::Boolean(_), Value::Boolean(_)) => Ok(value.clone()),
        (Value::Float(_), Value::Integer(i)) => Ok(Value::Float(*i as f64)),
        (Value::Integer(_), Value::Integer(i)) if *i >= 0 => Ok(value.clone()),
        // Users write large numbers of steps as 1e8.
        (Value::Integer(_), Value::Float(x)) if x.fract() == 0.0 && (0.0..9e15).contains(x) => {
            Ok(Value::Integer(*x as i64))
        }
        (Value::Array(expected), Value::Array(values)) => {
            let typed: Result<Vec<_>, _> = values.iter().map(|v| typed(&expected[0], v)).collect();
            typed.map(Value::Array).map_err(|rule| format!("an array of values that are each {rule}"))
        }
        (Value::Float(_), _) => Err("a number".into()),
        (Value::Integer(_), _) => Err("a whole number, not negative".into()),
        (Value::String(_), _) => Err("a string".into()),
        (Value::Boolean(_), _) => Err("true or false".into()),
        (Value::Array(_), _) => Err(format!("an array, e.g. {expected}")),
        (ramp, _) if is_ramp(ramp) => Err("a number, or { from = …, to = …, steps = …, after = … }".into()),
        (Value::Table(table), _) if table.is_empty() => {
            Err("a table of numbers by group of the observation, e.g. { joint_pos = 0.01 }".into())
        }
        (Value::Table(_), _) => Err("a section with keys".into()),
        _ => Err("of another type".into()),
    }
}

/// The most characters of an unknown name that a message shows.
const LONGEST_SHOWN: usize = 64;

fn unknown(name: &str) -> String {
    if name.len() > LONGEST_SHOWN {
        let start: String = name.chars().take(LONGEST_SHOWN).collect();
        return format!("{start}…: unknown key; configs/repose.toml lists all of them");
    }
    let base: Table = BASE.parse().expect("the built-in configuration is TOML");
    let mut known = Vec::new();
    for (section, keys) in &base {
        known.push(section.clone());
        if let Value::Table(keys) = keys {
            known.extend(keys.keys().map(|key| format!("{section}.{key}")));
        }
    }
    // A section is never suggested for a setting.
    let alike = known.iter().map(String::as_str).filter(|candidate| candidate.contains('.') || !name.contains('.'));
    match similar(name, alike, '.').first() {
        Some(nearest) => format!("{name}: unknown key; did you mean {nearest}?"),
        None => format!("{name}: unknown key; configs/repose.toml lists all of them"),
    }
}
