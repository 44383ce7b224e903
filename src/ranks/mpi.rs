//! Ranks that are processes on one or more machines, by MPI.
//!
//! Only data is moved: sums are computed here, in a fixed order, since MPI may add in any order.

use std::ops::Range;

use anyhow::{Context, Result, ensure};
use mpi::Threading;
use mpi::datatype::{Partition, PartitionMut};
use mpi::topology::SimpleCommunicator;
use mpi::traits::{Communicator, CommunicatorCollectives, Root};

use super::Ranks;

pub(super) use mpi::environment::Universe;

/// The most bytes in one message: MPI counts in 32 bits.
const LONGEST: usize = 1 << 30;

/// This process among all that were started together.
pub(super) struct Mpi {
    rank: usize,
    size: usize,
}

/// Starts MPI. When the first value is dropped, MPI ends, which waits for the other processes.
///
/// # Errors
/// Fails if this MPI does not allow calls from more than one thread.
pub(super) fn join() -> Result<(Universe, Mpi)> {
    // The learner runs on a worker thread, everything else on the main thread, one at a time.
    let (universe, granted) = mpi::initialize_with_threading(Threading::Serialized).context("MPI was started twice")?;
    ensure!(granted >= Threading::Serialized, "this MPI allows calls from one thread only ({granted:?})");
    let world = universe.world();
    let (rank, size) = (world.rank() as usize, world.size() as usize);
    Ok((universe, Mpi { rank, size }))
}

/// Returns the communicator. It cannot be kept: with some versions of MPI it must not be passed between threads.
fn world() -> SimpleCommunicator {
    SimpleCommunicator::world()
}

/// Returns these numbers as MPI counts them.
fn counts(numbers: impl Iterator<Item = usize>) -> Vec<i32> {
    numbers.map(|n| n.try_into().expect("fewer than 2^31 weights, and bytes of states")).collect()
}

impl Ranks for Mpi {
    fn size(&self) -> usize {
        self.size
    }

    fn rank(&self) -> usize {
        self.rank
    }

    fn all_to_all(&self, numbers: &[f32], slices: &[Range<usize>]) -> Vec<f32> {
        let own = slices[self.rank].len();
        let mut received = vec![0.0; own * self.size];
        let [sent_counts, sent_firsts] =
            [counts(slices.iter().map(Range::len)), counts(slices.iter().map(|slice| slice.start))];
        let [counts, firsts] = [counts((0..self.size).map(|_| own)), counts((0..self.size).map(|rank| rank * own))];
        let sent = Partition::new(numbers, sent_counts, sent_firsts);
        world().all_to_all_varcount_into(&sent, &mut PartitionMut::new(&mut received[..], counts, firsts));
        received
    }

    fn all_gather_slices(&self, numbers: &mut [f32], slices: &[Range<usize>]) {
        let own = numbers[slices[self.rank].clone()].to_vec();
        let [counts, firsts] = [counts(slices.iter().map(Range::len)), counts(slices.iter().map(|slice| slice.start))];
        world().all_gather_varcount_into(&own[..], &mut PartitionMut::new(numbers, counts, firsts));
    }

    fn all_gather(&self, bytes: Vec<u8>) -> Vec<Vec<u8>> {
        let mut lengths = vec![0_u64; self.size];
        world().all_gather_into(&(bytes.len() as u64), &mut lengths[..]);
        let lengths: Vec<usize> = lengths.into_iter().map(|length| length as usize).collect();
        let firsts = lengths.iter().scan(0, |end, length| {
            *end += length;
            Some(*end - length)
        });
        let (firsts, mut all) = (counts(firsts), vec![0; lengths.iter().sum()]);
        let mut places = PartitionMut::new(&mut all[..], counts(lengths.iter().copied()), firsts);
        world().all_gather_varcount_into(&bytes[..], &mut places);
        drop(places);
        let mut rest = &all[..];
        let cut = |length| rest.split_off(..length).expect("the bytes of all ranks").to_vec();
        lengths.into_iter().map(cut).collect()
    }

    fn broadcast(&self, mut bytes: Vec<u8>) -> Vec<u8> {
        let world = world();
        let first = world.process_at_rank(0);
        let mut length = bytes.len() as u64;
        first.broadcast_into(&mut length);
        bytes.resize(length as usize, 0);
        bytes.chunks_mut(LONGEST).for_each(|part| first.broadcast_into(part));
        bytes
    }

    fn abort(&self) -> ! {
        world().abort(1)
    }
}
