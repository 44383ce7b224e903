//! Live hands on a page. Nothing moves while nobody looks.

use std::rc::Rc;
use std::sync::Arc;
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::Result;
use base64::prelude::{BASE64_STANDARD, Engine};
use serde_json::{Value, json};

use super::clock::Clock;
use super::columns::{About, Columns};
use super::sliders::Sliders;
use crate::env::End;
use crate::evaluate::{Episodes, Player};
use crate::os::{self, Machine, Place, Server};
use crate::repose::{Task, TaskReward, add};
use crate::sim::Camera;

/// The time between two rows, s, rounded to control steps. A page interpolates between rows.
const BETWEEN_ROWS: f64 = 0.02;

/// The time between two looks at the clock.
const TICK: Duration = Duration::from_millis(5);

/// Takes one step of an episode, and returns its end if there is one.
type Stepping = dyn Fn(&mut Player) -> Option<End>;

/// Who acts in an episode.
#[derive(Clone)]
pub struct LiveActor {
    /// Takes one step.
    pub step: Rc<Stepping>,
    /// The page's name for the policy, if it differs from the name for the whole page.
    pub policy: Option<String>,
    /// The task that it acts in.
    pub task: Arc<Task>,
}

/// Hands on a page of this machine.
pub struct Live {
    columns: Columns,
    server: Arc<Server>,
    sliders: Option<Sliders>,
    key: String,
    /// Control steps from row to row.
    every: u64,
    episodes: Episodes,
    hands: Vec<LiveHand>,
}

/// A hand on the page.
struct LiveHand {
    player: Player,
    acting: LiveActor,
    /// What the page says of its episode.
    about: Value,
    has_ended: bool,
    /// The sum since the last row.
    reward: TaskReward,
}

impl Live {
    /// Serves a page with `hands` hands at this place, and says where. The first episodes are `acting`'s.
    ///
    /// # Errors
    /// Fails if the port cannot be opened.
    pub fn open(
        place: Place,
        (about, camera): (&About, Option<Camera>),
        hands: usize,
        acting: &LiveActor,
        sliders: Option<Sliders>,
    ) -> Result<Self> {
        let task = &acting.task;
        let mut columns = Columns::new(task, camera);
        let every = (BETWEEN_ROWS / task.config.ctrl_dt).round().max(1.0) as u64;
        let mut more = json!({ "live": true, "hands": hands, "every": every });
        if let Some(sliders) = &sliders {
            more["sliders"] = sliders.described();
        }
        let page = columns.page(about, more, Vec::new());
        let key = page.key();
        let episodes = Episodes::scored(about.seed.unwrap_or(0), usize::MAX);
        let hands: Vec<_> = (0..hands)
            .map(|episode| LiveHand::new(acting.clone(), episode, episodes))
            .collect();
        let hello = hello(&key, &hands, sliders.as_ref());
        let server = Server::open(
            place,
            page.html(),
            &hello,
            sliders.as_ref().map(Sliders::on_post),
        )?;
        let Server { port, token, .. } = &*server;
        let machine = Machine::this().name;
        os::say!(
            "the hand is at http://127.0.0.1:{port}/{token} (Ctrl-C ends)\n\
             from another machine: ssh -L {port}:127.0.0.1:{port} {machine}, and the same address there"
        );
        if let Some(host) = place.1 {
            os::say!("by a proxy: its address at {host} for port {port}, with {token} at the end");
        }
        Ok(Self {
            columns,
            server,
            sliders,
            key,
            every,
            episodes,
            hands,
        })
    }

    /// Shows the hands for as long as the program runs. `next` says who acts in each further episode.
    pub fn show(mut self, next: &mut dyn FnMut() -> LiveActor) -> ! {
        let start = Instant::now();
        let mut clock = Clock::new(self.hands[0].acting.task.config.ctrl_dt);
        let mut steps = 0_u64;
        let mut begun = self.hands.len();
        loop {
            if self.server.wait_for_reader() {
                clock.pause();
            }
            if let Some(sliders) = self.sliders.as_ref().filter(|sliders| sliders.take_moved()) {
                self.greet();
                self.server.send(&event("controls", &sliders.values()));
            }
            for _ in 0..clock.steps_due(1.0) {
                for hand in 0..self.hands.len() {
                    if self.hands[hand].has_ended {
                        self.begin(hand, begun, next());
                        begun += 1;
                    } else {
                        self.hands[hand].step();
                    }
                }
                steps += 1;
                if steps.is_multiple_of(self.every) {
                    let row = self.row();
                    self.server.send(&format!(
                        "id: {}\ndata: {row}\n\n",
                        start.elapsed().as_millis()
                    ));
                }
            }
            sleep(TICK);
        }
    }

    fn begin(&mut self, hand: usize, episode: usize, acting: LiveActor) {
        self.hands[hand] = LiveHand::new(acting, episode, self.episodes);
        let mut about = self.hands[hand].about.clone();
        about["hand"] = hand.into();
        // First, so that a viewer who comes in between knows it.
        self.greet();
        self.server.send(&event("episode", &about));
    }

    fn greet(&self) {
        self.server
            .greet(&hello(&self.key, &self.hands, self.sliders.as_ref()));
    }

    /// The row of all hands, as the page reads it.
    fn row(&mut self) -> String {
        let rows = self.hands.iter_mut().flat_map(|hand| {
            let reward = std::mem::take(&mut hand.reward);
            self.columns.of(&hand.player.lane.env, reward)
        });
        let bytes: Vec<u8> = rows
            .flat_map(|value| (value as f32).to_le_bytes())
            .collect();
        BASE64_STANDARD.encode(bytes)
    }
}

impl LiveHand {
    /// Begins one of these episodes, by its number.
    fn new(acting: LiveActor, episode: usize, episodes: Episodes) -> Self {
        let player = Player::new(
            &acting.task,
            Episodes {
                first: episode,
                ..episodes
            },
        );
        let mut about = json!({ "seed": format!("{}, episode {episode}", episodes.seed) });
        if let Some(policy) = &acting.policy {
            about["policy"] = policy.as_str().into();
        }
        Self {
            player,
            acting,
            about,
            has_ended: false,
            reward: TaskReward::default(),
        }
    }

    fn step(&mut self) {
        self.has_ended = (self.acting.step)(&mut self.player).is_some();
        add(&mut self.reward, self.player.lane.env.last.reward);
    }
}

/// The first event for a viewer: the key of the page, and what is under way.
fn hello(key: &str, hands: &[LiveHand], sliders: Option<&Sliders>) -> String {
    let episodes: Value = hands.iter().map(|hand| hand.about.clone()).collect();
    let mut hello = json!({ "key": key, "episodes": episodes });
    if let Some(sliders) = sliders {
        hello["controls"] = sliders.values();
    }
    event("hello", &hello)
}

/// An event as the protocol writes it.
fn event(name: &str, data: &Value) -> String {
    format!("event: {name}\ndata: {data}\n\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Settings;

    #[test]
    fn each_episode_is_played_in_the_task_of_the_policy_that_acts() {
        let task = |sets: &[&str]| {
            let sets: Vec<_> = sets.iter().map(|set| set.parse().unwrap()).collect();
            let config = Settings::new().sets(&sets).resolve().unwrap();
            Task::new(&config).unwrap()
        };
        let acting = |task: &Arc<Task>| LiveActor {
            step: Rc::new(|_| None),
            policy: None,
            task: task.clone(),
        };
        let about = About {
            title: "A hand".into(),
            policy: None,
            seed: None,
        };
        let [first, second] = [task(&[]), task(&["env.max_episode_seconds=3"])];
        let mut live = Live::open((0, None), (&about, None), 1, &acting(&first), None).unwrap();
        let seconds = |live: &Live| {
            live.hands[0]
                .player
                .lane
                .env
                .task
                .config
                .max_episode_seconds
        };
        assert_eq!(seconds(&live), 10.0);
        live.begin(0, 1, acting(&second));
        assert_eq!(seconds(&live), 3.0);
        assert_eq!(live.hands[0].about["seed"], "0, episode 1");
    }
}
