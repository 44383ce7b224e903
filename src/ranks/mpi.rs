//! Ranks that are processes on one or more machines, by MPI.
//!
//! Only data is moved: sums are computed here, in a fixed order, since MPI may add in any order.

use std::ops::Range;

use anyhow::{Context, Result, ensure};
use mpi::Threading;
use mpi::datatype::{Partition, PartitionMut};
use mpi::topology::SimpleCommunicator;
use mpi::traits::{Communicator, CommunicatorCollectives, Equivalence};

use super::Ranks;

pub(super) use mpi::environment::Universe;

/// This process among all that were started together.
pub struct Mpi {
    pub rank: usize,
    pub size: usize,
}

/// Starts MPI. When the first value is dropped, MPI ends, which waits for the other processes.
///
/// # Errors
/// Fails if this MPI does not allow calls from more than one thread.
pub fn join() -> Result<(Universe, Mpi)> {
    // The learner runs on a worker thread, everything else on the main thread, one at a time.
    let (universe, granted) =
        mpi::initialize_with_threading(Threading::Serialized).context("MPI was started twice")?;
    ensure!(
        granted >= Threading::Serialized,
        "this MPI allows calls from one thread only ({granted:?})"
    );
    let world = universe.world();
    let rank = world.rank() as usize;
    let size = world.size() as usize;
    Ok((universe, Mpi { rank, size }))
}

/// The communicator. It cannot be kept: with some versions of MPI it must not be passed between threads.
fn world() -> SimpleCommunicator {
    SimpleCommunicator::world()
}

/// The lengths and the beginnings of slices, as MPI counts them: in 32 bits.
fn counts(slices: &[Range<usize>]) -> (Vec<i32>, Vec<i32>) {
    let count = |n: usize| -> i32 {
        n.try_into()
            .expect("fewer than 2^31 weights, and bytes of states")
    };
    slices
        .iter()
        .map(|slice| (count(slice.len()), count(slice.start)))
        .unzip()
}

/// The slices of `array` that the ranks write, one after another.
fn places<'a, T: Equivalence>(
    array: &'a mut [T],
    slices: &[Range<usize>],
) -> PartitionMut<'a, [T], Vec<i32>, Vec<i32>> {
    let (lengths, firsts) = counts(slices);
    PartitionMut::new(array, lengths, firsts)
}

impl Ranks for Mpi {
    fn all_to_all(&self, numbers: &[f32], slices: &[Range<usize>]) -> Vec<f32> {
        let own = slices[self.rank].len();
        let mut received = vec![0.0; own * self.size];
        let of_ranks: Vec<Range<usize>> = (0..self.size)
            .map(|rank| rank * own..(rank + 1) * own)
            .collect();
        let (lengths, firsts) = counts(slices);
        let sent = Partition::new(numbers, lengths, firsts);
        world().all_to_all_varcount_into(&sent, &mut places(&mut received, &of_ranks));
        received
    }

    fn all_gather_slices(&self, numbers: &mut [f32], slices: &[Range<usize>]) {
        let own = numbers[slices[self.rank].clone()].to_vec();
        world().all_gather_varcount_into(&own[..], &mut places(numbers, slices));
    }

    fn all_gather(&self, bytes: Vec<u8>) -> Vec<Vec<u8>> {
        let mut lengths = vec![0_u64; self.size];
        world().all_gather_into(&(bytes.len() as u64), &mut lengths[..]);
        let mut end = 0;
        let slice = |length: u64| {
            let first = end;
            end += length as usize;
            first..end
        };
        let slices: Vec<Range<usize>> = lengths.into_iter().map(slice).collect();
        let mut all = vec![0; end];
        world().all_gather_varcount_into(&bytes[..], &mut places(&mut all, &slices));
        slices
            .into_iter()
            .map(|slice| all[slice].to_vec())
            .collect()
    }

    fn abort(&self) -> ! {
        world().abort(1)
    }
}
