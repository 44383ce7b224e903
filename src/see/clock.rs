//! The clock of a live display.

use std::time::Instant;

/// The maximum lag, in seconds, of a machine that cannot keep up. A longer control step is still played.
const LARGEST_LAG: f64 = 0.25;

/// A clock that converts elapsed time into control steps.
pub struct Clock {
    ctrl_dt: f64,
    last: Instant,
    /// Scene time that is still to be played, s.
    owed: f64,
}

impl Clock {
    pub fn new(ctrl_dt: f64) -> Self {
        Self {
            ctrl_dt,
            last: Instant::now(),
            owed: 0.0,
        }
    }

    /// The steps since the last call, at this multiple of real time.
    pub fn steps_due(&mut self, speed: f64) -> u32 {
        let most = (LARGEST_LAG * speed.max(1.0)).max(self.ctrl_dt);
        self.owed = most.min(self.owed + self.last.elapsed().as_secs_f64() * speed);
        self.last = Instant::now();
        let steps = (self.owed / self.ctrl_dt).floor();
        self.owed -= steps * self.ctrl_dt;
        steps as u32
    }

    /// Lets the time since the last call pass without steps.
    pub fn pause(&mut self) {
        *self = Self::new(self.ctrl_dt);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn the_time_of_a_pause_is_not_made_up_for() {
        let mut clock = Clock::new(1e-3);
        clock.last -= Duration::from_secs(10);
        clock.pause();
        assert!(clock.steps_due(1.0) < 200);
    }

    #[test]
    fn a_machine_that_is_too_slow_falls_behind_instead_of_stalling() {
        let mut clock = Clock::new(0.01);
        clock.last -= Duration::from_secs(60);
        assert_eq!(clock.steps_due(1.0), 25);
        let mut slow = Clock::new(0.3);
        slow.last -= Duration::from_secs(60);
        assert_eq!(
            slow.steps_due(0.5),
            1,
            "a control step may be longer than the lag"
        );
    }
}
