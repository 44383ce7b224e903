//! Fatal errors of MuJoCo, e.g. when a scene needs more memory than it has reserved. MuJoCo ends the process, but the program
//! can first save what must not be lost.

#![expect(unsafe_code, reason = "MuJoCo takes a C function")]

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, Once};

use mujoco_rs::wrappers::mj_logging::{MjLogMessage, MjtLogLevel};

use crate::os::{drain, locked, remove_unfinished, say};

type Rescue = Box<dyn FnOnce(&str) + Send>;

static RESCUE: Mutex<Option<Rescue>> = Mutex::new(None);

thread_local! {
    static STEPPED: Cell<Option<(&'static str, usize)>> = const { Cell::new(None) };
}

/// Does the `work` of stepping or resetting one of many simulations, "environment 12" or "episode 3". A fatal error during it
/// is reported with this name.
pub fn stepping<T>(kind: &'static str, number: usize, work: impl FnOnce() -> T) -> T {
    STEPPED.set(Some((kind, number)));
    let done = work();
    STEPPED.set(None);
    done
}

/// Registers `rescue` to be called with a message, on the thread that failed, before MuJoCo ends the process. It replaces
/// any function registered before. Other threads keep running meanwhile. If MuJoCo also fails on one of them, that thread
/// waits until `rescue` has returned.
pub fn before_fatal_error(rescue: impl FnOnce(&str) + Send + 'static) {
    *locked(&RESCUE) = Some(Box::new(rescue));
}

/// Discards MuJoCo's messages except for fatal errors: no `MUJOCO_LOG.TXT`, and no line per diverged state, which
/// [`super::Simulation::step`] returns as a value.
pub fn quieten_mujoco() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // SAFETY: every use of MuJoCo in this program starts with loading a scene, so no other thread can be inside MuJoCo.
        unsafe { mujoco_rs::logging::set_log_handler(report_fatal) };
    });
}

/// Reports a fatal error. MuJoCo ends the process with code 1 after this returns.
fn report_fatal(message: &MjLogMessage) {
    if message.level() != MjtLogLevel::mjLOG_ERROR {
        return;
    }
    let whose = STEPPED
        .get()
        .map_or(String::new(), |(kind, number)| format!("{kind} {number}: "));
    let said = format!("{whose}MuJoCo cannot continue: {}", message.subject());
    let mut rescue = locked(&RESCUE);
    // A panic must not unwind through MuJoCo's frames.
    let _ = catch_unwind(AssertUnwindSafe(|| match rescue.take() {
        Some(rescue) => rescue(&said),
        None => say!("error: {said}"),
    }));
    drain();
    remove_unfinished();
}
