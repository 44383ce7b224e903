//! The score of played episodes, as one JSON object and as a table.

use serde_json::{Value, json};

use crate::goal_times::GoalTimes;
use crate::os::number;
use crate::repose::{Score, named, task_terms};

/// The object that `--json` prints. Unknown values are null.
pub fn json_score(
    score: &Score,
    goal_times: &GoalTimes,
    checkpoint: Option<&str>,
    seed: u64,
) -> Value {
    let mut object = Value::Object(score.as_json());
    object["checkpoint"] = json!(checkpoint);
    object["seed"] = json!(seed);
    for (name, known) in goal_times.named() {
        object[name] = known;
    }
    object
}

/// A table with a row for each measure and a column for each named score. Two columns fit into 60 characters.
pub fn table(columns: &[(&str, Score)]) -> String {
    let mut text = format!("{:<21}", "");
    for (name, _) in columns {
        text += &format!(" {name:>18}");
    }
    let columns: Vec<_> = columns.iter().map(|(_, score)| lines(score)).collect();
    for (row, (label, _)) in columns[0].iter().enumerate() {
        text += &format!("\n{label:<21}");
        for column in &columns {
            text += &format!(" {:>18}", column[row].1);
        }
    }
    text + "\n"
}

/// The labels and values of a column.
fn lines(score: &Score) -> Vec<(String, String)> {
    let mut lines = vec![("episodes".to_owned(), score.episodes.to_string())];
    for (measure, value) in score.measured() {
        lines.push((measure.label(), measure.text(value)));
        if measure.column == "goals" && score.episodes > 1 {
            let [low, high] = score.goals_ci95.map(|goals| measure.text(goals));
            lines.push(("  95 % interval".to_owned(), format!("{low} … {high}")));
        }
    }
    let terms = named(task_terms(), score.reward);
    lines.extend(terms.map(|(term, value)| (format!("  {term}"), number(value, 2))));
    lines.push(("diverged episodes".to_owned(), score.diverged.to_string()));
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::repose::EpisodeStats;

    #[test]
    fn the_json_of_a_score_says_of_which_policy_it_is_and_how_long_goals_took() {
        let goal_times = GoalTimes::new(&Config::default().env);
        let score = Score::of(
            &[EpisodeStats {
                length: 10,
                ..Default::default()
            }],
            0.01,
        );
        let value = json_score(&score, &goal_times, None, 3);
        let keys: Vec<&str> = value
            .as_object()
            .unwrap()
            .keys()
            .map(String::as_str)
            .collect();
        let (of_score, others) = keys.split_at(keys.len() - 5);
        assert_eq!(of_score, score.as_json().keys().collect::<Vec<_>>());
        assert_eq!(
            others,
            [
                "checkpoint",
                "seed",
                "steps_to_goal",
                "drops_first_second",
                "steps_fit"
            ]
        );
        assert!(value["checkpoint"].is_null() && value["seed"] == 3);
    }

    #[test]
    fn the_table_has_a_column_for_each_score() {
        let score = Score::of(
            &[EpisodeStats {
                length: 10,
                goals: 2,
                ..Default::default()
            }],
            0.01,
        );
        let text = table(&[("policy", score), ("zero actions", score)]);
        let goals = text
            .lines()
            .find(|line| line.starts_with("goals per episode"))
            .unwrap();
        assert_eq!(goals.matches("2.000").count(), 2, "{text}");
    }
}
