//! Tables on stdout: lines as wide as the terminal, shown once or repeatedly in the same place.

use anyhow::Result;
use console::{Term, measure_text_width, truncate_str};

use super::progress::is_dumb;
use super::terminal::is_read;

/// The screen that shows a table. Where stdout is no terminal, lines are not cut, and follow the earlier ones.
#[derive(Default)]
pub struct Screen {
    /// The number of lines that were shown last.
    shown: Option<usize>,
}

impl Screen {
    /// Shows lines in place of the previous ones, as many as fit below each other. Returns whether somebody reads them.
    ///
    /// # Errors
    /// Fails if stdout cannot be written to.
    pub fn show(&mut self, mut lines: Vec<String>) -> Result<bool> {
        let terminal = Term::stdout();
        let size = terminal.size_checked().filter(|_| !is_dumb());
        // One line is left for the cursor.
        let fitting = size.map_or(usize::MAX, |(height, _)| usize::from(height.max(3)) - 1);
        if lines.len() > fitting {
            let more = lines.len() - (fitting - 1);
            lines.truncate(fitting - 1);
            lines.push(format!("… {more} more"));
        }
        let back = match self.shown.replace(lines.len()) {
            Some(before) if size.is_some() => format!("\x1b[{before}A\r\x1b[J"),
            Some(_) => "\n".into(),
            None => String::new(),
        };
        is_read(&(back + &text_of(&lines)))
    }
}

/// Lines as a text, cut to the width of the terminal on which it is printed, if there is one.
pub fn text_of(lines: &[String]) -> String {
    let width = Term::stdout()
        .size_checked()
        .map(|(_, columns)| usize::from(columns));
    let cut = |line: &String| {
        width.map_or(line.clone(), |width| {
            truncate_str(line, width, "…").into_owned()
        })
    };
    lines.iter().map(|line| cut(line) + "\n").collect()
}

/// Rows as lines with aligned columns. The first `words` columns are aligned to the left, the others to the right, and the
/// last one stays as it is.
pub fn aligned(rows: &[Vec<String>], words: usize) -> Vec<String> {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| {
        let cells = rows.iter().filter_map(|row| row.get(column));
        cells.map(|cell| measure_text_width(cell)).max()
    };
    let widths: Vec<usize> = (0..columns).filter_map(width).collect();
    let cell = |(column, text): (usize, &String)| -> String {
        let room = " ".repeat(widths[column] - measure_text_width(text));
        match column {
            _ if column + 1 == columns => text.clone(),
            _ if column < words => text.clone() + &room,
            _ => room + text,
        }
    };
    let line = |row: &Vec<String>| {
        row.iter()
            .enumerate()
            .map(cell)
            .collect::<Vec<_>>()
            .join("  ")
            .trim_end()
            .to_owned()
    };
    rows.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_stand_to_the_left_and_numbers_to_the_right_of_their_columns() {
        let rows = [
            ["run", "steps", "settings"],
            ["long name", "7", ""],
            ["手", "1000000", "a=1"],
        ];
        let lines = aligned(&rows.map(|row| row.map(String::from).to_vec()), 1);
        assert_eq!(
            lines[..2],
            ["run          steps  settings", "long name        7"]
        );
        assert_eq!(
            measure_text_width(&lines[2]),
            measure_text_width(&lines[0]) - "settings".len() + "a=1".len()
        );
    }
}
