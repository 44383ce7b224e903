//! The largest allocation of a training once it runs. A separate binary, because a process has only one allocator.

#![allow(unsafe_code)]
#![allow(clippy::unwrap_used)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use shadow_repose::agent::Agent;
use shadow_repose::config::Settings;
use shadow_repose::ranks::Exchange;
use shadow_repose::repose::Task;

struct Watching;

static NEVER: AtomicBool = AtomicBool::new(false);

static LARGEST: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call is forwarded to the system's allocator.
unsafe impl GlobalAlloc for Watching {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller upholds the contract.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        // SAFETY: the caller upholds the contract.
        unsafe { System.dealloc(ptr, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Watching = Watching;

#[test]
fn after_the_first_iteration_no_array_of_samples_or_weights_is_allocated() {
    let sets = ["env.num_envs=256", "ppo.hidden=[256,128,64]"].map(|set| set.parse().unwrap());
    let config = Settings::new().sets(&sets).resolve().unwrap();
    let task = Task::new(&config).unwrap();
    let size = task.spaces().observation_size;
    let mut agent = Agent::for_task(&task, &config, Exchange::alone(config.shards())).unwrap();
    let mut iterate = || {
        LARGEST.store(0, Ordering::Relaxed);
        agent.iterate(&NEVER).unwrap();
        LARGEST.load(Ordering::Relaxed)
    };
    let first = iterate();
    let later = [iterate(), iterate()];
    // gemm packs the largest weight matrix, of the first layer, into its own buffer. An array of all weights, or of a block of rows
    // in a net, would be larger. An array of all samples would be much larger.
    let packed = 4 * size * config.ppo.hidden[0];
    assert!(
        first > 500_000 && later.iter().all(|&largest| largest <= packed),
        "{first} bytes, then {later:?}"
    );
}
