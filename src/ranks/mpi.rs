//! Ranks that are processes on one or more machines, by MPI.
//!
//! Only data is moved: sums are computed here, in a fixed order, since MPI may add in any.

use std::ops::Range;

use anyhow::{Context, Result, ensure};
use mpi::Threading;
use mpi::datatype::{Partition, PartitionMut};
use mpi::topology::SimpleCommunicator;
use mpi::traits::{Communicator, CommunicatorCollectives, Destination, Root, Source};

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
    numbers.map(|n| n.try_into().expect("a net has fewer than 2^31 weights")).collect()
}

fn send(bytes: &[u8], to: i32) {
    let peer = world();
    let peer = peer.process_at_rank(to);
    peer.send(&(bytes.len() as u64));
    bytes.chunks(LONGEST).for_each(|part| peer.send(part));
}

fn receive(from: i32) -> Vec<u8> {
    let peer = world();
    let peer = peer.process_at_rank(from);
    let (length, _) = peer.receive::<u64>();
    let mut bytes = vec![0; length as usize];
    bytes.chunks_mut(LONGEST).for_each(|part| {
        peer.receive_into(part);
    });
    bytes
}

impl Ranks for Mpi {
    fn size(&self) -> usize {
        self.size
    }

    fn rank(&self) -> usize {
        self.rank
    }

    fn exchange(&self, numbers: &[f32], parts: &[Range<usize>]) -> Vec<f32> {
        let own = parts[self.rank].len();
        let mut received = vec![0.0; own * self.size];
        let [sent_counts, sent_firsts] =
            [counts(parts.iter().map(Range::len)), counts(parts.iter().map(|part| part.start))];
        let [counts, firsts] = [counts((0..self.size).map(|_| own)), counts((0..self.size).map(|rank| rank * own))];
        let sent = Partition::new(numbers, sent_counts, sent_firsts);
        world().all_to_all_varcount_into(&sent, &mut PartitionMut::new(&mut received[..], counts, firsts));
        received
    }

    fn share(&self, numbers: &mut [f32], parts: &[Range<usize>]) {
        let own = numbers[parts[self.rank].clone()].to_vec();
        let [counts, firsts] = [counts(parts.iter().map(Range::len)), counts(parts.iter().map(|part| part.start))];
        world().all_gather_varcount_into(&own[..], &mut PartitionMut::new(numbers, counts, firsts));
    }

    fn gather(&self, numbers: Vec<f64>) -> Vec<f64> {
        let mut all = vec![0.0; numbers.len() * self.size];
        world().all_gather_into(&numbers[..], &mut all[..]);
        all
    }

    fn gather_at_first(&self, bytes: Vec<u8>) -> Vec<Vec<u8>> {
        if self.rank > 0 {
            send(&bytes, 0);
            return Vec::new();
        }
        std::iter::once(bytes).chain((1..self.size).map(|rank| receive(rank as i32))).collect()
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
