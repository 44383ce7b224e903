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
use super::sliders::{Order, Sliders};
use crate::env::End;
use crate::evaluate::{Episodes, Player};
use crate::os::{self, Machine, Place, Server};
use crate::repose::{Task, TaskReward, add};
use crate::sim::Camera;

/// The time between two rows, s, rounded to control steps. A page interpolates between rows.
const BETWEEN_ROWS: f64 = 0.02;

/// The time for which a push acts, unless it is asked for again.
const HELD: Duration = Duration::from_millis(400);

/// The largest force of a push along an axis, N.
const STRONGEST: f64 = 50.0;

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
    about: About,
    camera: Option<Camera>,
    columns: Columns,
    server: Arc<Server>,
    sliders: Sliders,
    key: String,
    /// Control steps from row to row.
    every: u64,
    episodes: Episodes,
    hands: Vec<LiveHand>,
    /// The newest row, as it was sent.
    row: String,
}

/// A hand on the page.
struct LiveHand {
    player: Player,
    acting: LiveActor,
    /// What the page says of its episode.
    about: Value,
    has_ended: bool,
    /// The force on its object, N, and when it was asked for.
    push: Option<([f64; 3], Instant)>,
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
        sliders: Sliders,
    ) -> Result<Self> {
        let mut columns = Columns::new(&acting.task, camera);
        let every = (BETWEEN_ROWS / acting.task.config.ctrl_dt).round().max(1.0) as u64;
        let more = more(hands, every, &sliders, &acting.task);
        let page = columns.page(about, more, Vec::new());
        let key = page.key();
        let episodes = Episodes::scored(about.seed.unwrap_or(0), usize::MAX);
        let hands: Vec<_> = (0..hands)
            .map(|episode| LiveHand::new(acting.clone(), episode, episodes))
            .collect();
        let hello = hello(&key, &hands, &sliders);
        let server = Server::open(place, page.html(), &hello, sliders.on_post())?;
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
            about: about.clone(),
            camera,
            columns,
            server,
            sliders,
            key,
            every,
            episodes,
            hands,
            row: String::new(),
        })
    }

    /// Shows the hands for as long as the program runs. `next` says who acts in each further episode.
    pub fn show(mut self, next: &mut dyn FnMut() -> LiveActor) -> ! {
        let start = Instant::now();
        let mut clock = Clock::new(self.hands[0].acting.task.config.ctrl_dt);
        let mut steps = 0_u64;
        let mut paused = false;
        let mut begun = self.hands.len();
        loop {
            if self.server.wait_for_reader() {
                clock.pause();
            }
            let orders = self.listen();
            let mut single = 0;
            for order in &orders {
                match order {
                    Order::Pause => paused = !paused,
                    Order::Step => {
                        paused = true;
                        single += 1;
                    }
                    _ => {
                        self.obey(*order);
                        // A pause shows a new goal or episode by a step.
                        single += u32::from(matches!(order, Order::Goal | Order::Episode));
                    }
                }
            }
            let due = if paused {
                clock.pause();
                single
            } else {
                clock.steps_due(1.0)
            };
            for _ in 0..due {
                for hand in 0..self.hands.len() {
                    if self.hands[hand].has_ended {
                        self.begin(hand, begun, next());
                        begun += 1;
                    } else {
                        self.hands[hand].step();
                    }
                }
                steps += 1;
                if paused || steps.is_multiple_of(self.every) {
                    self.send_row(start);
                }
            }
            sleep(TICK);
        }
    }

    /// Takes over what the sliders say, and returns the other orders of the page.
    fn listen(&mut self) -> Vec<Order> {
        let orders = self.sliders.take_orders();
        if self.sliders.take_moved() {
            self.server.greet(&self.hello());
            let values = json!(self.sliders.values());
            self.server.send(&event("controls", &values));
            let factors = self.sliders.factors();
            for hand in &mut self.hands {
                hand.vary(&factors);
            }
        }
        orders
    }

    fn obey(&mut self, order: Order) {
        for (i, hand) in self.hands.iter_mut().enumerate() {
            match order {
                Order::Push(of, force) if of == i => {
                    let force = force.map(|x| x.clamp(-STRONGEST, STRONGEST));
                    hand.push = Some((force, Instant::now()));
                }
                Order::Goal => hand.player.new_goal(),
                Order::Episode => hand.has_ended = true,
                _ => {}
            }
        }
    }

    fn begin(&mut self, hand: usize, episode: usize, acting: LiveActor) {
        let size = |task: &Task| task.config.cube_size_scale;
        if size(&acting.task) != size(&self.columns.task) {
            self.redraw(&acting.task);
        }
        self.hands[hand] = LiveHand::new(acting, episode, self.episodes);
        self.hands[hand].vary(&self.sliders.factors());
        let mut about = self.hands[hand].about.clone();
        about["hand"] = hand.into();
        // First, so that a viewer who comes in between knows it.
        self.server.greet(&self.hello());
        self.server.send(&event("episode", &about));
    }

    /// Serves a page with the shapes of another task. Readers of the old one load it when they are greeted.
    fn redraw(&mut self, task: &Arc<Task>) {
        self.columns = Columns::new(task, self.camera);
        let more = more(self.hands.len(), self.every, &self.sliders, task);
        let page = self.columns.page(&self.about, more, Vec::new());
        self.key = page.key();
        self.server.replace_page(page.html());
        self.server.send(&self.hello());
        // No hand goes on in the old shapes.
        self.hands.iter_mut().for_each(|hand| hand.has_ended = true);
    }

    fn hello(&self) -> String {
        hello(&self.key, &self.hands, &self.sliders) + &self.row
    }

    /// Sends the row of all hands, as the page reads it.
    fn send_row(&mut self, start: Instant) {
        let rows = self.hands.iter_mut().flat_map(|hand| {
            let reward = std::mem::take(&mut hand.reward);
            self.columns.of(&hand.player.lane.env, reward)
        });
        let bytes: Vec<u8> = rows
            .flat_map(|value| (value as f32).to_le_bytes())
            .collect();
        let row = BASE64_STANDARD.encode(bytes);
        let time = start.elapsed().as_millis();
        self.row = format!("id: {time}\ndata: {row}\n\n");
        self.server.send(&self.row);
        self.server.greet(&self.hello());
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
            push: None,
            reward: TaskReward::default(),
        }
    }

    /// Changes the physics by these factors. A hand whose physics has diverged ends its episode.
    fn vary(&mut self, factors: &[(&str, f64)]) {
        if !factors.is_empty() {
            self.has_ended |= self.player.lane.env.vary(factors).is_err();
        }
    }

    fn step(&mut self) {
        if let Some((force, since)) = self.push {
            let lasts = since.elapsed() < HELD;
            let env = &mut self.player.lane.env;
            let object = env.task.hand.object.body;
            env.sim.push(object, if lasts { force } else { [0.0; 3] });
            self.push = lasts.then_some((force, since));
        }
        self.has_ended = (self.acting.step)(&mut self.player).is_some();
        add(&mut self.reward, self.player.lane.env.last.reward);
    }
}

/// What a live page needs to know besides what it shows.
fn more(hands: usize, every: u64, sliders: &Sliders, task: &Task) -> Value {
    let object = &task.hand.object;
    let pushed = sliders
        .takes_orders()
        .then(|| json!({ "at": object.qpos, "mass": task.scene.mass(object.body) }));
    json!({
        "live": true,
        "hands": hands,
        "every": every,
        "sliders": sliders.described(),
        "object": pushed,
    })
}

/// The first event for a viewer: the key of the page, and what is under way.
fn hello(key: &str, hands: &[LiveHand], sliders: &Sliders) -> String {
    let episodes: Value = hands.iter().map(|hand| hand.about.clone()).collect();
    let hello = json!({ "key": key, "episodes": episodes, "controls": sliders.values() });
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
    use crate::evaluate::Actor;
    use crate::see::Slider;

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
        let mut live = Live::open(
            (0, None),
            (&about, None),
            1,
            &acting(&first),
            Sliders::new(Vec::new(), false),
        )
        .unwrap();
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

    #[test]
    fn a_page_pushes_the_object_and_changes_its_world() {
        let task = Task::new(&Settings::new().resolve().unwrap()).unwrap();
        let acting = LiveActor {
            step: Rc::new(|player| player.step(&Actor::Zero)),
            policy: None,
            task: task.clone(),
        };
        let about = About {
            title: "A hand".into(),
            policy: None,
            seed: None,
        };
        let mass = Slider::new("mass", [0.1, 3.0], 0.0, 1.0, Some("cube_mass"));
        let sliders = Sliders::new(vec![mass], true);
        let post = sliders.on_post();
        let open = |sliders: &Sliders| {
            Live::open((0, None), (&about, None), 1, &acting, sliders.clone()).unwrap()
        };
        let height = |live: &mut Live| {
            (0..10).for_each(|_| live.hands[0].step());
            live.hands[0].player.lane.env.object().position[2]
        };
        let heights = [&b"[]"[..], b"{\"push\":[0,[0,0,1]]}", b"[[0,0.1]]"].map(|body| {
            let mut live = open(&sliders);
            post(body).unwrap();
            for order in live.listen() {
                live.obey(order);
            }
            let state = live.hands[0].player.lane.env.sim.state();
            assert!(state.iter().all(|x| x.is_finite()));
            height(&mut live)
        });
        assert!(heights[1] > heights[0] + 0.02, "{heights:?}");
        assert_ne!(heights[2], heights[0]);
        let mut live = open(&sliders);
        post(b"\"reset\"").unwrap();
        assert_eq!(live.listen(), [Order::Reset]);
        assert_eq!(height(&mut live), heights[0], "as the task has it");
        let env = &mut live.hands[0].player.lane.env;
        let goal = env.goal;
        live.obey(Order::Goal);
        assert_ne!(live.hands[0].player.lane.env.goal, goal);
        live.obey(Order::Episode);
        assert!(live.hands[0].has_ended);
        let key = live.key.clone();
        let larger = ["env.cube_size_scale=1.2".parse().unwrap()];
        let larger = Task::new(&Settings::new().sets(&larger).resolve().unwrap()).unwrap();
        live.begin(
            0,
            1,
            LiveActor {
                task: larger,
                ..acting.clone()
            },
        );
        assert_ne!(live.key, key, "a page with other shapes");
    }
}
