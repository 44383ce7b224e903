//! The options of the commands that look at the results of runs.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::values::{count, destination, size};
use crate::os::Destination;

/// The options of `plot`.
#[derive(Args)]
pub struct PlotArgs {
    /// Run folders, or tables such as their metrics.csv
    #[arg(required = true, value_name = "RUN")]
    pub runs: Vec<PathBuf>,
    /// Picture to write, as .svg or .png
    #[arg(long, value_name = "FILE", default_value = "learning.svg", value_parser = destination(&["svg", "png"]))]
    pub out: Destination,
    /// Column of metrics.csv to plot in its own panel; repeatable [default: goals in evaluations; goals, turning and
    /// drop rate in training]
    #[arg(long, value_name = "COLUMN")]
    pub metric: Vec<String>,
    /// Quantity on the x axis: control steps, or hours of collecting and learning
    #[arg(long, value_enum, default_value_t = Along::Steps)]
    pub along: Along,
    /// Number of iterations averaged into each point, each as long as the first one; if runs differ, the shortest length counts
    /// [default: a tenth of the shortest run, at most 50]
    #[arg(long, value_name = "N", value_parser = count())]
    pub smooth: Option<usize>,
    /// Runs, or tables, to draw in grey and without their names, behind the others
    #[arg(long, value_name = "RUN", num_args = 1..)]
    pub behind: Vec<PathBuf>,
    /// Draw the mean of all runs (seeds of one setting), with a band from the lowest to the highest
    #[arg(long)]
    pub seeds: bool,
    /// Size of the picture in pixels [default: width 800, height 260 per panel]
    #[arg(long, value_name = "WxH", value_parser = size)]
    pub size: Option<[u32; 2]>,
}

/// The quantity on the x axis of a learning curve.
#[derive(Clone, Copy, ValueEnum)]
pub enum Along {
    /// Control steps over all environments
    Steps,
    /// Hours of collecting and learning, without evaluations and saving
    Hours,
}

/// The options of `runs`.
#[derive(Args)]
pub struct RunsArgs {
    /// Folder of runs to list, or single runs: two are compared, any other number is listed [default: runs/shadow-hand-repose]
    #[arg(value_name = "DIR|RUN")]
    pub places: Vec<PathBuf>,
    /// Print one JSON array, or one object if two runs are compared
    #[arg(long)]
    pub json: bool,
    /// Refresh the table every few seconds until Ctrl-C; waits for the first run
    #[arg(long, conflicts_with = "json")]
    pub watch: bool,
}
