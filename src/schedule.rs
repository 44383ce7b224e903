//! Runs blocks of work through many rounds on all threads, without a barrier between the rounds.
//!
//! A block is what one thread works on at a time; its rounds happen in order. Whoever is free takes the next round of the
//! next block, so that threads wait for one another only at the very end. What a block holds must not depend on the number
//! of threads: then neither does the result.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// The number of items in each block, for `items` of them: few enough for many threads, enough for whole vectors of work.
pub fn block_sizes(items: usize) -> Vec<usize> {
    let size = (items / 32).clamp(8, 64);
    (0..items).step_by(size).map(|first| size.min(items - first)).collect()
}

/// Calls `work(block, round)` for each block and each round below `rounds` on the threads of rayon's current pool.
///
/// # Panics
/// If `work` does, after the other threads have finished what they were at.
pub fn in_rounds<B: Send>(
    blocks: impl IntoIterator<Item = B>,
    rounds: usize,
    work: impl Fn(&mut B, usize) + Sync,
) -> Vec<B> {
    let blocks: Vec<Mutex<(B, usize)>> = blocks.into_iter().map(|block| Mutex::new((block, 0))).collect();
    let tickets = AtomicUsize::new(0);
    rayon::broadcast(|_| {
        loop {
            let ticket = tickets.fetch_add(1, Ordering::Relaxed);
            if ticket >= rounds * blocks.len() {
                break;
            }
            // Which round it is, the block knows: its last one may have been taken by another thread that is still at it.
            let Ok(mut locked) = blocks[ticket % blocks.len()].lock() else {
                break; // `work` has panicked; that panic goes on when all threads are back.
            };
            let (block, round) = &mut *locked;
            work(block, *round);
            *round += 1;
        }
    });
    blocks.into_iter().map(|block| block.into_inner().expect("a panic has left already").0).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_block_goes_through_all_rounds_in_order_on_any_number_of_threads() {
        for threads in [1, 2, 8] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            for blocks in [1, 3, 20] {
                let seen = pool.install(|| in_rounds(vec![Vec::new(); blocks], 50, |seen, round| seen.push(round)));
                assert_eq!(seen, vec![(0..50).collect::<Vec<_>>(); blocks], "{threads} threads, {blocks} blocks");
            }
        }
    }

    #[test]
    fn a_panic_in_one_block_ends_the_call_instead_of_hanging_it() {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(4).build().unwrap();
        let panicking = || pool.install(|| in_rounds(0..6, 10, |&mut block, round| assert!(block != 4 || round != 3)));
        assert!(std::panic::catch_unwind(std::panic::AssertUnwindSafe(panicking)).is_err());
    }

    #[test]
    fn blocks_hold_all_items_once() {
        for items in [1, 7, 8, 9, 64, 1000, 1024, 8192] {
            let sizes = block_sizes(items);
            assert_eq!(sizes.iter().sum::<usize>(), items);
            let (last, first) = sizes.split_last().unwrap();
            assert!(first.iter().all(|size| size == &sizes[0]) && *last <= sizes[0] && *last > 0);
        }
        assert_eq!((block_sizes(1024)[0], block_sizes(8192)[0], block_sizes(1).len()), (32, 64, 1));
    }
}
