//! The times that goals take in `play --json` agree with the trace of the same episodes.

use std::fs;

use serde_json::Value;
use shadow_repose::quat::{self, Quat};

use crate::support::{program, succeeded, task};

#[test]
fn how_long_goals_take_is_what_the_trace_shows() {
    let place = tempfile::tempdir().unwrap();
    let mut args = vec![
        "play",
        "--ckpt",
        "builtin",
        "--episodes",
        "12",
        "--json",
        "--out",
        "trace.jsonl",
    ];
    let task_settings = [
        "env.max_episode_seconds=1.6",
        "env.max_consecutive_successes=5",
        "env.fall_dist=0.105",
    ];
    task_settings
        .iter()
        .for_each(|set| args.extend(["--set", set]));
    let score: Value =
        serde_json::from_slice(&succeeded(program(place.path(), &args)).stdout).unwrap();
    let text = fs::read_to_string(place.path().join("trace.jsonl")).unwrap();
    let records: Vec<Value> = text
        .lines()
        .skip(1)
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    let object = task(&[]).scene.free_body("cube").unwrap().qpos;
    let orientation = |of: &Value| -> Quat { std::array::from_fn(|i| of[i].as_f64().unwrap()) };

    // Step and angle at which the goal in force was given. Then episode, steps and angle of each goal that was reached.
    let (mut given, mut early) = ((0, 0.0), 0);
    let mut reached: Vec<(&Value, i64, f64)> = Vec::new();
    for (record, next) in records
        .iter()
        .zip(records[1..].iter().chain([&Value::Null]))
    {
        let (step, is_reset) = (record["step"].as_i64().unwrap(), record["reset"] == true);
        let known = reached
            .iter()
            .filter(|(episode, ..)| *episode == &record["episode"])
            .count();
        let done = !is_reset && record["goals"] != known;
        if done {
            reached.push((&record["episode"], step - given.0, given.1));
        }
        if (done || is_reset) && next["episode"] == record["episode"] {
            let lies: Vec<Value> =
                record["qpos"].as_array().unwrap()[object + 3..object + 7].to_vec();
            given = (
                step,
                quat::angle_between(orientation(&Value::from(lies)), orientation(&next["goal"])),
            );
        }
        early += i64::from(record["terminated"] == true && step <= 100);
    }
    assert!(
        reached.len() > 5 && early > 0,
        "{} goals, {early} early drops",
        reached.len()
    );

    let number = |group: &str, key: &str| score[group][key].as_f64().unwrap();
    let close = |found: f64, expected: f64| {
        assert!(
            (found - expected).abs() < 1e-6,
            "{found} {expected}: {score}"
        )
    };
    let mut steps: Vec<i64> = reached.iter().map(|(_, steps, _)| *steps).collect();
    steps.sort_unstable();
    let count = reached.len() as f64;
    close(
        number("steps_to_goal", "mean"),
        steps.iter().sum::<i64>() as f64 / count,
    );
    let middle = [(steps.len() - 1) / 2, steps.len() / 2].map(|i| steps[i] as f64);
    close(
        number("steps_to_goal", "p50"),
        (middle[0] + middle[1]) / 2.0,
    );
    close(
        score["drops_first_second"].as_f64().unwrap(),
        early as f64 / 12.0,
    );
    // The residuals of the least-squares line sum to 0, also when weighted by the angle.
    let [settle, per_rad] = ["settle", "per_rad"].map(|key| number("steps_fit", key));
    let residual =
        |(_, steps, angle): &(&Value, i64, f64)| (*steps - 5) as f64 - settle - per_rad * angle;
    close(reached.iter().map(residual).sum::<f64>() / count, 0.0);
    close(
        reached
            .iter()
            .map(|goal| residual(goal) * goal.2)
            .sum::<f64>()
            / count,
        0.0,
    );
}
