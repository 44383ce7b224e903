//! The folder of a run and what is logged into it: checkpoints, metrics, TensorBoard events.

mod checkpoints;
mod events;
mod folder;
mod glance;
mod histogram;
mod hparams;
mod kept;
mod metrics;
mod records;
mod report;
mod summary;
mod table;

pub use checkpoints::Checkpoints;
pub use events::SETTINGS;
pub use folder::{RunFolder, newest_run, resolve_checkpoint};
pub use glance::{Glance, folders_of_runs};
pub use histogram::{Histogram, histogram};
pub use kept::{expect_other_policy, expect_output};
pub use report::Report;
pub use summary::Descriptions;
pub use table::{MetricsTable, read_metrics, table_of, value_at};
