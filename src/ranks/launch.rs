//! How this process was started: alone, or by a launcher as one of several.

use std::sync::Arc;

use anyhow::{Result, bail};

use super::{Alone, Ranks};

/// What a launcher has said about this process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Launched {
    /// The index of this process.
    pub rank: usize,
    /// The number of processes.
    pub size: usize,
}

/// The variables in which launchers tell size and rank: OpenMPI, MPICH and its relatives, Slurm.
const TOLD: [(&str, &str); 3] = [
    ("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK"),
    ("PMI_SIZE", "PMI_RANK"),
    ("SLURM_STEP_NUM_TASKS", "SLURM_PROCID"),
];

/// Returns what a launcher has said, if this process is one of several.
pub fn launched() -> Option<Launched> {
    told(|name| std::env::var(name).ok())
}

/// Returns whether OpenMPI's mpirun has started this process, be it alone or with others. It binds one or two processes to a core
/// each.
pub fn launched_by_mpirun() -> bool {
    std::env::var_os(TOLD[0].0).is_some()
}

fn told(variable: impl Fn(&str) -> Option<String>) -> Option<Launched> {
    let number = |name| variable(name)?.trim().parse::<usize>().ok();
    TOLD.into_iter().find_map(|(size, rank)| {
        let size = number(size).filter(|&size| size > 1)?;
        Some(Launched { rank: number(rank).unwrap_or(0), size })
    })
}

/// This process as a member of its ranks. When it is dropped, it leaves them, which waits for the others.
pub struct Membership {
    /// The ranks.
    pub ranks: Arc<dyn Ranks>,
    #[cfg(feature = "mpi")]
    _universe: Option<super::mpi::Universe>,
}

impl Membership {
    fn alone() -> Self {
        Self {
            ranks: Arc::new(Alone),
            #[cfg(feature = "mpi")]
            _universe: None,
        }
    }
}

/// Joins the processes that the launcher has started together with this one; without a launcher, there is one rank.
///
/// # Errors
/// Fails if there should be several ranks, but this process cannot talk to the others.
#[cfg(feature = "mpi")]
pub fn join() -> Result<Membership> {
    let Some(Launched { size, .. }) = launched() else { return Ok(Membership::alone()) };
    let (universe, ranks) = super::mpi::join()?;
    if ranks.size() == 1 {
        bail!(
            "{size} processes were started, but each finds itself alone; under Slurm, start them with srun --mpi=pmix, or with the \
             mpirun of the MPI that this program was built with"
        );
    }
    Ok(Membership { ranks: Arc::new(ranks), _universe: Some(universe) })
}

/// The same in a build that cannot talk to other processes.
///
/// # Errors
/// Fails if there should be several ranks.
#[cfg(not(feature = "mpi"))]
pub fn join() -> Result<Membership> {
    if let Some(Launched { size, .. }) = launched() {
        bail!(
            "{size} processes were started, but this build has no MPI: each would train on its own; build with --features mpi \
             (docs/CLUSTER.md), or start one process"
        );
    }
    Ok(Membership::alone())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_is_one_of_several_where_a_launcher_says_so() {
        let of = |variables: &[(&str, &str)]| {
            told(|name| variables.iter().find(|(other, _)| *other == name).map(|(_, value)| value.to_string()))
        };
        assert_eq!(of(&[]), None);
        assert_eq!(of(&[("PMI_SIZE", "1"), ("PMI_RANK", "0")]), None);
        let expected = Some(Launched { rank: 3, size: 4 });
        assert_eq!(of(&[("OMPI_COMM_WORLD_SIZE", "4"), ("OMPI_COMM_WORLD_RANK", "3")]), expected);
        assert_eq!(of(&[("PMI_SIZE", "4"), ("PMI_RANK", "3")]), expected);
        assert_eq!(of(&[("SLURM_STEP_NUM_TASKS", "4"), ("SLURM_PROCID", "3")]), expected);
        // One launcher inside another: mpirun in a job step of one task.
        assert_eq!(of(&[("SLURM_STEP_NUM_TASKS", "1"), ("PMI_SIZE", "4"), ("PMI_RANK", "3")]), expected);
    }
}
