//! How this process was started: alone, or by a launcher as one of several.

use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Result, anyhow, bail};

use super::Exchange;
use crate::os;
use crate::schedule::caught;

/// The time that the first rank has to save and to report an error, before another rank reports it and ends all.
const PATIENCE: Duration = Duration::from_secs(5);

/// The variables in which launchers pass size and rank: OpenMPI, MPICH and its relatives, Slurm.
const TOLD: [(&str, &str); 3] = [
    ("OMPI_COMM_WORLD_SIZE", "OMPI_COMM_WORLD_RANK"),
    ("PMI_SIZE", "PMI_RANK"),
    ("SLURM_STEP_NUM_TASKS", "SLURM_PROCID"),
];

/// The rank of this process and the number of processes, if a launcher has said that this process is one of several.
fn launched() -> Option<(usize, usize)> {
    told(|name| std::env::var(name).ok())
}

/// Whether OpenMPI's mpirun has started this process, be it alone or with others. It binds one or two processes to a core
/// each.
pub fn launched_by_mpirun() -> bool {
    std::env::var_os(TOLD[0].0).is_some()
}

/// Whether this process speaks for all processes that were started together.
pub fn is_spokesman() -> bool {
    launched().is_none_or(|(rank, _)| rank == 0)
}

/// Checks that no launcher has started several processes, for what only one process can do.
///
/// # Errors
/// Fails if there are several.
pub fn expect_one() -> Result<()> {
    if let Some((_, size)) = launched() {
        bail!("only `train` runs on several ranks; {size} processes were started");
    }
    Ok(())
}

fn told(variable: impl Fn(&str) -> Option<String>) -> Option<(usize, usize)> {
    let number = |name| variable(name)?.trim().parse::<usize>().ok();
    TOLD.into_iter().find_map(|(size, rank)| {
        let size = number(size).filter(|&size| size > 1)?;
        Some((number(rank).unwrap_or(0), size))
    })
}

/// Joins the processes that the launcher has started together with this one, and returns the result of `work`. If it fails on
/// one of several, all end.
///
/// # Errors
/// Fails if there should be several, but this process cannot talk to the others. If this process is alone, fails as `work` does.
pub fn together(work: impl FnOnce(&Exchange) -> Result<ExitCode>) -> Result<ExitCode> {
    // When the second value is dropped, this process leaves the others, which waits for them.
    let (exchange, _membership) = &match join() {
        // All ranks hit the same error, and only rank 0 reports it.
        Err(_) if !is_spokesman() => return Ok(ExitCode::FAILURE),
        joined => joined?,
    };
    if exchange.is_alone() {
        return work(exchange);
    }
    if !exchange.is_first() {
        os::speak_as(&format!("rank {}", exchange.rank));
    }
    // Leaving the others means waiting for them, and they may be waiting for this one.
    let result = caught(|| work(exchange)).map_err(|panic| anyhow!("panic: {panic}"));
    result.flatten().or_else(|error| {
        if !exchange.is_first() {
            // An error that occurs on all ranks at once, such as a loss that is not finite, is reported by the first.
            std::thread::sleep(PATIENCE);
        }
        os::say!("error: {error:#}");
        os::drain();
        exchange.abort()
    })
}

#[cfg(feature = "mpi")]
fn join() -> Result<(Exchange, Option<super::mpi::Universe>)> {
    let Some((_, size)) = launched() else {
        return Ok((Exchange::alone(1), None));
    };
    let (universe, ranks) = super::mpi::join()?;
    let exchange = Exchange::new(ranks.rank, ranks.size, std::sync::Arc::new(ranks));
    if exchange.is_alone() {
        bail!(
            "{size} processes were started, but MPI did not connect them; under Slurm, start them with srun --mpi=pmix, or with the \
             mpirun of the MPI that this program was built with"
        );
    }
    Ok((exchange, Some(universe)))
}

#[cfg(not(feature = "mpi"))]
fn join() -> Result<(Exchange, ())> {
    if let Some((_, size)) = launched() {
        bail!(
            "{size} processes were started, but this build has no MPI: each would train on its own; build with --features mpi \
             (docs/CLUSTER.md), or start one process"
        );
    }
    Ok((Exchange::alone(1), ()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_is_one_of_several_where_a_launcher_says_so() {
        let of = |variables: &[(&str, &str)]| {
            told(|name| {
                variables
                    .iter()
                    .find(|(other, _)| *other == name)
                    .map(|(_, value)| value.to_string())
            })
        };
        assert_eq!(of(&[]), None);
        assert_eq!(of(&[("PMI_SIZE", "1"), ("PMI_RANK", "0")]), None);
        let expected = Some((3, 4));
        assert_eq!(
            of(&[("OMPI_COMM_WORLD_SIZE", "4"), ("OMPI_COMM_WORLD_RANK", "3")]),
            expected
        );
        assert_eq!(of(&[("PMI_SIZE", "4"), ("PMI_RANK", "3")]), expected);
        assert_eq!(
            of(&[("SLURM_STEP_NUM_TASKS", "4"), ("SLURM_PROCID", "3")]),
            expected
        );
        // One launcher inside another: mpirun in a job step of one task.
        assert_eq!(
            of(&[
                ("SLURM_STEP_NUM_TASKS", "1"),
                ("PMI_SIZE", "4"),
                ("PMI_RANK", "3")
            ]),
            expected
        );
    }
}
