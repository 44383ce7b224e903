//! What a training asks the allocator for, once it runs. Alone in its binary: the count is of the whole process.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use shadow_repose::collect::{Scratch, collect};
use shadow_repose::config::Config;
use shadow_repose::env::{ACTION_SIZE, EnvPool, OBSERVATION_SIZE, Repose, Task};
use shadow_repose::ppo::Ppo;

struct Watching;

static NEVER: AtomicBool = AtomicBool::new(false);

static LARGEST: AtomicUsize = AtomicUsize::new(0);

// SAFETY: all is left to the system's allocator.
unsafe impl GlobalAlloc for Watching {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Ordering::Relaxed);
        // SAFETY: as promised by the caller.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        // SAFETY: as promised by the caller.
        unsafe { System.dealloc(ptr, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Watching = Watching;

#[test]
fn after_the_first_iteration_no_array_of_samples_or_weights_is_allocated() {
    let config = Config::resolve(None, &[]).unwrap();
    let task = Task::new(&config.env).unwrap();
    let envs = 256;
    let mut pool = EnvPool::new(0, (0..envs).map(|_| Repose::new(&task)).collect());
    let mut ppo = Ppo::new(&config.ppo, OBSERVATION_SIZE, ACTION_SIZE, 0).unwrap();
    let (mut rollout, mut scratch) = (ppo.rollout(&pool.block_sizes()), Scratch::new(&pool, &ppo));
    pool.reset(rollout.first_observations_mut());
    let mut iterate = |iteration| {
        LARGEST.store(0, Ordering::Relaxed);
        collect(&mut pool, &ppo, &mut rollout, iteration, &mut scratch, &NEVER).unwrap();
        ppo.update(&mut rollout, iteration, &NEVER).unwrap().unwrap();
        rollout.carry_over();
        LARGEST.load(Ordering::Relaxed)
    };
    let first = iterate(1);
    let later = [iterate(2), iterate(3)];
    // gemm packs the largest weight, 157 × 256 floats, into a buffer of its own. An array of all weights or of a block of rows
    // in a net would be larger, one of all samples much larger.
    let packed = 4 * OBSERVATION_SIZE * config.ppo.hidden[0];
    assert!(first > 500_000 && later.iter().all(|&largest| largest <= packed), "{first} bytes, then {later:?}");
}
