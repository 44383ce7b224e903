//! Runs blocks of work through many rounds on all threads, without a barrier between the rounds.
//!
//! One thread works on a block at a time, and the rounds of a block run in order. A free thread takes the next round of
//! the block that has waited longest. No thread waits for a block that another one is working on. If fewer blocks than
//! threads are left, the other threads leave. The content of a block must not depend on the number of threads. Then the
//! result does not depend on it.

use std::any::Any;
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Mutex;

/// The number of items in each block when `items` of a total of `in_all` items are split. There are enough
/// blocks for many threads, and enough items in each for full vectors of work.
pub fn block_sizes(items: usize, in_all: usize) -> Vec<usize> {
    let size = (in_all / 32).clamp(8, 64);
    (0..items)
        .step_by(size)
        .map(|first| size.min(items - first))
        .collect()
}

/// Calls `work(block, round)` for each block and each round below `rounds` on the threads of rayon's current pool, and
/// returns the blocks in their order.
///
/// # Panics
/// Panics if `work` does.
pub fn in_rounds<B: Send>(
    blocks: impl IntoIterator<Item = B>,
    rounds: usize,
    work: impl Fn(&mut B, usize) + Sync,
) -> Vec<B> {
    let mut blocks: Vec<B> = blocks.into_iter().collect();
    // Each block that waits, with its next round.
    let waiting: Mutex<VecDeque<(&mut B, usize)>> =
        Mutex::new(blocks.iter_mut().map(|block| (block, 0)).collect());
    // The lock is not held during work, so no panic can occur under it.
    let queue = || waiting.lock().expect("no panic under this lock");
    rayon::broadcast(|_| {
        // A closure gives the lock back before the work.
        let next = || queue().pop_front();
        while let Some((block, round)) = next() {
            if round < rounds {
                work(block, round);
                queue().push_back((block, round + 1));
            }
        }
    });
    drop(waiting);
    blocks
}

/// The result of `work`, or the message with which it panics. What the panic left inconsistent must not be used again.
///
/// # Errors
/// Fails if `work` panics.
pub fn caught<T>(work: impl FnOnce() -> T) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(work)).map_err(|panic| panic_message(&*panic).to_owned())
}

/// The message of a panic.
pub fn panic_message(panic: &(dyn Any + Send)) -> &str {
    panic
        .downcast_ref::<String>()
        .map(String::as_str)
        .or_else(|| panic.downcast_ref::<&str>().copied())
        .unwrap_or("no message")
}

#[cfg(test)]
mod tests {
    use super::*;
    use rayon::prelude::*;

    #[test]
    fn every_block_goes_through_all_rounds_in_order_on_any_number_of_threads() {
        for threads in [1, 2, 8] {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            for blocks in [1, 3, 20] {
                let seen = pool.install(|| {
                    in_rounds(vec![Vec::new(); blocks], 50, |seen, round| seen.push(round))
                });
                assert_eq!(
                    seen,
                    vec![(0..50).collect::<Vec<_>>(); blocks],
                    "{threads} threads, {blocks} blocks"
                );
                let numbers = pool.install(|| in_rounds(0..blocks, 3, |_, _| {}));
                assert!(
                    numbers.into_iter().eq(0..blocks),
                    "blocks are returned in order"
                );
            }
        }
    }

    /// A thread that waits inside one block for its own parallel work may pick up another block in the meantime.
    #[test]
    fn work_that_is_parallel_in_itself_does_not_hang() {
        for threads in [1, 2, 4] {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            let sums = pool.install(|| {
                in_rounds(vec![0u64; 5], 40, |sum, round| {
                    *sum += (0..2000u64)
                        .into_par_iter()
                        .map(|i| std::hint::black_box(i ^ round as u64))
                        .sum::<u64>();
                })
            });
            assert!(sums.iter().all(|&sum| sum == sums[0] && sum > 0));
        }
    }

    #[test]
    fn a_panic_in_one_block_ends_the_call_instead_of_hanging_it() {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(4)
            .build()
            .unwrap();
        let panicking = || {
            pool.install(|| {
                in_rounds(0..6, 10, |&mut block, round| {
                    assert!(block != 4 || round != 3)
                })
            })
        };
        assert!(std::panic::catch_unwind(std::panic::AssertUnwindSafe(panicking)).is_err());
    }

    #[test]
    fn blocks_hold_all_items_once() {
        for items in [1, 7, 8, 9, 64, 1000, 1024, 8192] {
            let sizes = block_sizes(items, items);
            assert_eq!(sizes.iter().sum::<usize>(), items);
            let (last, first) = sizes.split_last().unwrap();
            assert!(first.iter().all(|size| size == &sizes[0]) && *last <= sizes[0] && *last > 0);
        }
        assert_eq!(
            (
                block_sizes(1024, 1024)[0],
                block_sizes(8192, 8192)[0],
                block_sizes(1, 1).len()
            ),
            (32, 64, 1)
        );
        assert_eq!(block_sizes(64, 1024), [32, 32], "a shard of many");
    }
}
