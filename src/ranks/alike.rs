//! Checks that all ranks of a training run are alike, and warns if a launcher binds one of them to a single core.

use anyhow::{Result, ensure};

use super::{Exchange, launched_by_mpirun};
use crate::os::{self, Machine};

/// The most processors that a rank which is bound to one core may use: two, where a core runs two threads.
const ONE_CORE: usize = 2;

impl Exchange {
    /// Checks that this rank runs the same program on the same scene, by its fingerprint, as the first one. Returns a warning, on
    /// all ranks, if a launcher has bound one to a single core of a machine with more.
    ///
    /// # Errors
    /// Fails if the program or the scene differs.
    pub fn expect_alike(&self, scene: &str) -> Result<Option<String>> {
        if self.is_alone() && !launched_by_mpirun() {
            return Ok(None);
        }
        let all = self.all_gather((os::program_checksum(), scene.to_owned(), Machine::this()));
        for (rank, (program, scene, _)) in all.iter().enumerate() {
            ensure!(
                *program == all[0].0,
                "rank {rank} runs another program than rank 0"
            );
            ensure!(
                *scene == all[0].1,
                "rank {rank} has another scene than rank 0"
            );
        }
        let bound = all.iter().position(|(.., own)| {
            let here = all.iter().filter(|(.., other)| other.name == own.name);
            own.allowed <= ONE_CORE && own.allowed * here.count() < own.processors
        });
        Ok(bound.map(|rank| {
            let Machine { allowed, processors, .. } = all[rank].2;
            format!(
                "rank {rank} may use only {allowed} of the {processors} processors of its machine: start with mpirun --bind-to none, \
                 or --map-by ppr:1:node:PE={processors}, or srun --cpus-per-task"
            )
        }))
    }
}
