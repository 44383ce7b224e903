//! What happens when MuJoCo finds that it cannot go on, for instance because a scene needs more memory than it has reserved: it
//! ends the process. Before that, what must not be lost can be saved.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, Once};

use mujoco_rs::wrappers::mj_logging::{MjLogMessage, MjtLogLevel};

type Rescue = Box<dyn FnOnce(&str) + Send>;

static RESCUE: Mutex<Option<Rescue>> = Mutex::new(None);

/// Has `rescue` called before MuJoCo ends the process, with what it says, on the thread that it failed on, in place of what was
/// to be called so far. The other threads go on meanwhile, and none of them ends the process before it returns.
pub fn before_fatal_error(rescue: impl FnOnce(&str) + Send + 'static) {
    *RESCUE.lock().unwrap_or_else(|poisoned| poisoned.into_inner()) = Some(Box::new(rescue));
}

/// Sends MuJoCo's messages nowhere but for its fatal errors: no `MUJOCO_LOG.TXT`, and no line per diverged state, which
/// [`super::Simulation::step`] reports as a value.
pub fn quieten_mujoco() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        // SAFETY: every use of MuJoCo in this program begins with a loaded scene, so no other thread can be inside it.
        unsafe { mujoco_rs::logging::set_log_handler(report_fatal) };
    });
}

/// MuJoCo ends the process with code 1 after this returns from an error.
fn report_fatal(message: &MjLogMessage) {
    if message.level() != MjtLogLevel::mjLOG_ERROR {
        return;
    }
    let said = message.subject().to_string();
    let mut rescue = RESCUE.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    // A panic must not cross MuJoCo's frames.
    let _ = catch_unwind(AssertUnwindSafe(|| match rescue.take() {
        Some(rescue) => rescue(&said),
        None => {
            let text = format!("error: MuJoCo cannot go on: {said}\n");
            let _ = std::io::Write::write_all(&mut std::io::stderr(), text.as_bytes());
        }
    }));
}
