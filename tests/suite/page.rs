//! The page that shows a hand in a browser: what a file holds, what a browser does with it, and the server of a live page.

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use base64::prelude::{BASE64_STANDARD, Engine};
use flate2::read::GzDecoder;
use mujoco_rs::prelude::{MjData, MjModel};
use serde_json::{Value, json};

use crate::support::{command, names, program, stderr, succeeded, train};

const SHORT: [&str; 2] = ["--set", "env.max_episode_seconds=0.4"];

/// A hand of three fingers, and beside it a chain of bodies with all kinds of joints.
fn with_all_joints() -> String {
    let chain = r#"
    <body name="post" pos=".2 -.2 .3" quat=".9 .1 -.3 .2"><geom type="box" size=".05 .03 .02"/>
      <body pos="0 .1 .05" quat=".7 .7 0 .1">
        <joint type="hinge" axis="1 2 -.5" pos=".02 .01 -.03" ref=".4"/>
        <joint type="slide" axis="0 1 1" pos=".05 0 0" ref="-.1"/>
        <joint type="hinge" axis="0 0 1" pos="-.01 .04 .02"/>
        <geom type="capsule" size=".01 .05"/>
        <body pos=".03 .02 .1"><joint type="ball" pos=".01 -.02 .015"/><geom type="ellipsoid" size=".02 .03 .04"/>
          <body pos="0 0 .06" quat="0 1 0 0"><joint type="slide" axis="1 0 0"/><geom type="cylinder" size=".01 .02"/>
            <body pos=".01 .01 .01" quat="1 1 0 0"><geom type="sphere" size=".01"/></body>
          </body>
        </body>
      </body>
    </body>
    <body name="goal" mocap="true" pos=".1 .1 .4" quat="1 2 0 0">
      <geom type="box" size=".02 .02 .02" contype="0" conaffinity="0" rgba="1 0 0 .4"/>
    </body>
  </worldbody>"#;
    let scene = include_str!("three_fingers.xml").replace("</worldbody>", chain);
    scene.replace(
        "0 0 .245 1 0 0 0\"",
        "0 0 .245 1 0 0 0 .4 -.1 0 1 0 0 0 0\"",
    )
}

/// What is in an HTML file, read as `assets/page/FORMAT.md` says.
struct File {
    html: String,
    meta: Value,
    scene: Value,
    rows: Vec<Vec<f64>>,
}

impl File {
    fn read(path: &Path) -> Self {
        let html = fs::read_to_string(path).unwrap();
        let meta: Value = serde_json::from_str(block(&html, "meta")).unwrap();
        let scene = serde_json::from_slice(&unpacked(block(&html, "scene"))).unwrap();
        let scale: Vec<f64> = meta["scale"]
            .as_array()
            .unwrap()
            .iter()
            .map(|x| x.as_f64().unwrap())
            .collect();
        let (count, columns) = (meta["rows"].as_u64().unwrap() as usize, scale.len());
        let bytes = unpacked(block(&html, "rows"));
        assert_eq!(bytes.len(), 2 * count * columns);
        let mut rows = vec![vec![0.0; columns]; count];
        for column in 0..columns {
            let mut sum = 0_i16;
            for (row, values) in rows.iter_mut().enumerate() {
                let place = column * count + row;
                sum = sum.wrapping_add(i16::from_le_bytes([
                    bytes[place],
                    bytes[count * columns + place],
                ]));
                values[column] = f64::from(sum) * scale[column];
            }
        }
        Self {
            html,
            meta,
            scene,
            rows,
        }
    }

    /// Returns a scalar of a row.
    fn scalar(&self, row: usize, name: &str) -> f64 {
        let place = self.meta["scalars"]
            .as_array()
            .unwrap()
            .iter()
            .position(|scalar| scalar == name)
            .unwrap();
        self.rows[row][self.meta["numbers"].as_u64().unwrap() as usize + place]
    }

    /// Checks that the rows are the records of a trace, and returns the orientation of the goal in each.
    fn expect_trace(&self, trace: &Path) {
        let text = fs::read_to_string(trace).unwrap();
        let records: Vec<Value> = text
            .lines()
            .skip(1)
            .map(|line| serde_json::from_str(line).unwrap())
            .collect();
        assert_eq!(records.len(), self.rows.len());
        let list = |value: &Value| {
            value
                .as_array()
                .unwrap()
                .iter()
                .map(|x| x.as_f64().unwrap())
                .collect::<Vec<_>>()
        };
        for (row, record) in records.iter().enumerate() {
            let qpos = list(&record["qpos"]);
            // To half a step of 16 bits, but for the sign of quaternions.
            let near = |a: f64, b: f64| (a.abs() - b.abs()).abs() < 1e-4;
            assert!(
                qpos.iter().zip(&self.rows[row]).all(|(a, b)| near(*a, *b)),
                "row {row}"
            );
            let goal = &self.rows[row][self.meta["numbers"].as_u64().unwrap() as usize - 4..];
            assert!(
                list(&record["goal"])
                    .iter()
                    .zip(goal)
                    .all(|(a, b)| near(*a, *b)),
                "row {row}"
            );
            assert_eq!(self.scalar(row, "step"), record["step"].as_f64().unwrap());
            if record["reset"] == true {
                continue;
            }
            for (name, value) in [("held", &record["held"]), ("goals", &record["goals"])] {
                assert_eq!(
                    self.scalar(row, name),
                    value.as_f64().unwrap(),
                    "{name} of row {row}"
                );
            }
            for (name, value) in record["reward"]
                .as_object()
                .unwrap()
                .iter()
                .filter(|(name, _)| *name != "total")
            {
                assert!(
                    (self.scalar(row, name) - value.as_f64().unwrap()).abs() < 0.01,
                    "{name} of row {row}"
                );
            }
            assert!(
                (self.scalar(row, "error") - record["rot_dist"].as_f64().unwrap()).abs() < 1e-3,
                "row {row}"
            );
        }
    }

    /// Returns, by MuJoCo, the poses of all bodies in each row as x, y, z, w, qx, qy, qz.
    fn poses(&self, scene: &Path) -> Vec<Vec<Vec<f64>>> {
        let model = MjModel::from_xml(scene).unwrap();
        let numbers = self.meta["numbers"].as_u64().unwrap() as usize;
        let mut data = MjData::new(&model);
        let of_row = |row: &Vec<f64>| {
            let positions = model.nq() as usize;
            assert_eq!(positions + 7, numbers);
            data.qpos_mut().copy_from_slice(&row[..positions]);
            data.mocap_pos_mut()[0].copy_from_slice(&row[positions..positions + 3]);
            data.mocap_quat_mut()[0].copy_from_slice(&row[positions + 3..numbers]);
            data.kinematics();
            let poses = data.xpos().iter().zip(data.xquat());
            poses
                .map(|(place, turn)| [&place[..], &turn[..]].concat())
                .collect()
        };
        self.rows.iter().map(of_row).collect()
    }
}

fn block<'a>(html: &'a str, name: &str) -> &'a str {
    let (_, rest) = html.split_once(&format!("id=\"{name}\">")).unwrap();
    rest.split_once("</script>").unwrap().0
}

fn unpacked(text: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    GzDecoder::new(&*BASE64_STANDARD.decode(text).unwrap())
        .read_to_end(&mut bytes)
        .unwrap();
    bytes
}

/// Returns node, if there is one.
fn node() -> Option<Command> {
    let node = || Command::new("node");
    if node().arg("--version").output().is_err() {
        eprintln!("not tested: the code of the page; node is missing");
        return None;
    }
    Some(node())
}

fn code(name: &str) -> String {
    format!("{}/assets/page/{name}.js", env!("CARGO_MANIFEST_DIR"))
}

#[test]
fn a_file_holds_what_the_trace_holds_and_the_page_makes_the_poses_of_mujoco_of_it() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("joints.xml"), with_all_joints()).unwrap();
    let builtin = concat!(env!("CARGO_MANIFEST_DIR"), "/assets/shadow_hand/scene.xml").to_owned();
    for (scene, sets, policy) in [
        (builtin, &[][..], &["--ckpt", "builtin"][..]),
        (
            folder.join("joints.xml").display().to_string(),
            &["--set", "env.model=joints.xml"],
            &["--ckpt", "random"],
        ),
    ] {
        let play = [
            &[
                "play",
                "--episodes",
                "2",
                "--plain",
                "--out",
                "t.jsonl",
                "--out",
                "x.html",
            ],
            policy,
        ];
        succeeded(program(
            folder,
            &[&play.concat()[..], sets, &SHORT].concat(),
        ));
        let file = File::read(&folder.join("x.html"));
        file.expect_trace(&folder.join("t.jsonl"));
        assert_eq!(file.meta["episodes"].as_array().unwrap().len(), 2);
        assert_eq!(file.meta["settings"]["env.max_episode_seconds"], 0.4);
        assert_eq!(
            (&file.meta["seed"], &file.meta["dt"], &file.meta["live"]),
            (&json!("0"), &json!(0.01), &json!(false))
        );
        // The same from the trace alone, which knows all settings but the place of the scene.
        let again = [
            "play",
            "--plain",
            "--from-trace",
            "t.jsonl",
            "--out",
            "y.html",
        ];
        succeeded(program(folder, &[&again[..], sets].concat()));
        let from_trace = File::read(&folder.join("y.html"));
        from_trace.expect_trace(&folder.join("t.jsonl"));
        for key in [
            "title",
            "seed",
            "settings",
            "dt",
            "hold",
            "tolerance",
            "terms",
        ] {
            assert_eq!(from_trace.meta[key], file.meta[key], "{key}");
        }
        assert_eq!(from_trace.scene, file.scene);
        let Some(mut node) = node() else { continue };
        let poses = file.poses(Path::new(&scene)).into_iter().enumerate();
        let poses: Vec<Value> = poses
            .map(|(row, expected)| json!({ "row": row, "expected": expected }))
            .collect();
        let code = ["format", "shapes"]
            .map(|name| fs::read_to_string(code(name)).unwrap())
            .join("\n");
        let given = json!({
            "code": code,
            "meta": file.meta,
            "scene": block(&file.html, "scene"),
            "rows": block(&file.html, "rows"),
            "meshes": block(&file.html, "meshes"),
            "poses": poses,
        });
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/suite/page.mjs");
        let started = node
            .arg(script)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn();
        let mut started = started.unwrap();
        started
            .stdin
            .take()
            .unwrap()
            .write_all(given.to_string().as_bytes())
            .unwrap();
        let output = succeeded(started.wait_with_output().unwrap());
        let found: Value = serde_json::from_slice(&output.stdout).unwrap();
        let (far, turned) = (
            found["far"].as_f64().unwrap(),
            found["turned"].as_f64().unwrap(),
        );
        assert!(
            far < 5e-5 && turned < 1e-3,
            "{scene}: {far} m, {turned} rad"
        );
        assert_eq!(found["episodes"], 2);
    }
}

#[test]
fn the_page_shows_every_digit_of_a_large_seed() {
    let folder = tempfile::tempdir().unwrap();
    let play = ["play", "--ckpt", "zero", "--plain", "--out", "x.html"];
    // JavaScript has no such number.
    let seed = "9007199254740993";
    succeeded(program(
        folder.path(),
        &[&play[..], &["--seed", seed], &SHORT].concat(),
    ));
    let file = File::read(&folder.path().join("x.html"));
    assert_eq!(file.meta["seed"], seed);
}

#[test]
fn the_code_of_the_page_is_javascript() {
    for entry in fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/assets/page")).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|end| end == "js")
            && let Some(mut node) = node()
        {
            succeeded(node.arg("--check").arg(&path).output().unwrap());
        }
    }
}

#[test]
fn a_trace_that_cannot_be_shown_is_refused_by_its_line() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("joints.xml"), with_all_joints()).unwrap();
    let random = [
        "play",
        "--ckpt",
        "random",
        "--headless",
        "--episodes",
        "1",
        "--out",
    ];
    succeeded(program(
        folder,
        &[&random[..], &["t.jsonl"], &SHORT].concat(),
    ));
    succeeded(program(
        folder,
        &[
            &random[..],
            &["own.jsonl", "--set", "env.model=joints.xml"],
            &SHORT,
        ]
        .concat(),
    ));
    let text = fs::read_to_string(folder.join("t.jsonl")).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    let changed = |changes: &[(usize, &str)]| {
        let mut lines = lines.clone();
        changes
            .iter()
            .for_each(|(line, text)| lines[line - 1] = text);
        lines.join("\n")
    };
    let other = lines[2].replacen("\"qpos\":[", "\"qpos\":[0.5,", 1);
    let large = lines[2].replacen("\"qpos\":[", "\"qpos\":[1e300],\"old\":[", 1);
    let steps = lines[2].replacen("\"step\":1", "\"step\":40000", 1);
    let older = lines[0].replacen("\"settings\"", "\"others\"", 1);
    for (text, sets, part) in [
        (String::new(), &[][..], "header of a trace"),
        ("{\"a\":1}\n".to_owned(), &[], "header of a trace"),
        (lines[0].to_owned(), &[], "it has no records"),
        (
            changed(&[(2, "")]),
            &[],
            "line 3: it is not the first record of an episode",
        ),
        (
            changed(&[(2, lines[2])]),
            &[],
            "line 2: it is not the first record of an episode",
        ),
        (
            changed(&[(3, &other)]),
            &[],
            "line 3: `qpos` is not a list of 31 numbers",
        ),
        (changed(&[(3, &large)]), &[], "line 3: `qpos`"),
        (
            changed(&[(3, &steps)]),
            &[],
            "line 3: `step` is not a count up to 32767",
        ),
        (changed(&[(1, &older)]), &[], "it has no settings"),
        (
            changed(&[(3, &"[".repeat(1 << 23))]),
            &[],
            "it has a line of more than 4194304 bytes",
        ),
        (
            text.clone(),
            &["--set", "env.ctrl_dt=0.02"],
            "a trace has its own settings",
        ),
        (
            fs::read_to_string(folder.join("own.jsonl")).unwrap(),
            &[],
            "set env.model=joints.xml to use",
        ),
        (
            text.clone(),
            &["--set", "env.model=joints.xml"],
            "it was recorded with another hand, which has other joints",
        ),
    ] {
        fs::write(folder.join("bad.jsonl"), text).unwrap();
        let output = program(
            folder,
            &[
                &["play", "--out", "x.html", "--from-trace", "bad.jsonl"],
                sets,
            ]
            .concat(),
        );
        let said = stderr(&output);
        assert!(
            output.status.code() == Some(1) && said.contains(part),
            "{part:?} is not in\n{said}"
        );
        assert!(!folder.join("x.html").exists());
    }
}

/// Has Chromium open a file, and returns what it prints, or `None` if there is no Chromium.
fn chromium(options: &[&str], page: &str) -> Option<(String, String)> {
    let folder = tempfile::tempdir().unwrap();
    let own = format!("--user-data-dir={}", folder.path().display());
    let mut chromium = Command::new("chromium");
    // Without a sandbox, which a container does not allow. Messages of the page's console go to stderr.
    chromium.args([
        "--headless",
        "--no-sandbox",
        "--enable-logging=stderr",
        "--virtual-time-budget=4000",
        &own,
    ]);
    let output = chromium
        .args(["--window-size=900,700"])
        .args(options)
        .arg(page)
        .output();
    let Ok(output) = output else {
        assert!(
            std::env::var_os("SHADOW_REPOSE_BROWSES").is_none(),
            "CI has installed Chromium"
        );
        eprintln!("not tested: a page in a browser; chromium is missing");
        return None;
    };
    Some((
        String::from_utf8_lossy(&output.stdout).into_owned(),
        stderr(&output),
    ))
}

#[test]
fn a_browser_draws_the_file_with_and_without_webgl_and_has_nothing_to_complain_of() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    // A name that would end a script.
    let policy = "</script><!--.safetensors";
    fs::create_dir(folder.join("<")).unwrap();
    fs::copy(
        concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/assets/policies/repose.safetensors"
        ),
        folder.join(policy),
    )
    .unwrap();
    // With this seed, two faces of the cube are large in the picture.
    let play = [
        "play", "--ckpt", policy, "--out", "x.html", "--plain", "--seed", "7",
    ];
    succeeded(program(folder, &[&play, &SHORT[..]].concat()));
    let page = format!("file://{}#t=0.2", folder.join("x.html").display());
    let software = [
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
    ];
    for (options, says) in [
        (&software[..], false),
        (&["--disable-gpu", "--disable-3d-apis"], true),
    ] {
        let Some((document, console)) = chromium(&[options, &["--dump-dom"]].concat(), &page)
        else {
            return;
        };
        assert!(
            document.contains("0.20 s, step 20"),
            "{document}\n{console}"
        );
        assert!(
            document.contains("from the goal (") && document.contains("seed 7, 2 changed settings"),
            "{document}"
        );
        assert_eq!(
            document.contains("role=\"status\">This browser offers no WebGL 2"),
            says
        );
        assert!(!console.contains("CONSOLE"), "{console}");
        let picture = folder.join("x.png");
        let to = format!("--screenshot={}", picture.display());
        chromium(&[options, &[&to]].concat(), &page);
        #[cfg(feature = "video")]
        assert!(crate::support::colours_of_the_cube(&crate::pictures::picture(&picture).1) >= 2);
    }
}

/// A program that shows a hand on a page.
struct Live {
    program: Child,
    port: u16,
    /// The end of the address, from a question mark on.
    query: String,
    /// What it has said since it said the address.
    later: Arc<Mutex<String>>,
}

impl Live {
    fn start(folder: &Path, args: &[&str]) -> Self {
        let program = command(folder, args)
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut live = Self {
            program,
            port: 0,
            query: String::new(),
            later: Arc::default(),
        };
        let mut said = BufReader::new(live.program.stderr.take().unwrap());
        let mut all = String::new();
        while live.port == 0 {
            assert!(said.read_line(&mut all).unwrap() > 0, "{all}");
            let address = all
                .split_once("http://127.0.0.1:")
                .and_then(|(_, rest)| rest.split(' ').next())
                .and_then(|address| address.split_once('/'));
            let Some((port, query)) = address else {
                continue;
            };
            live.port = port.parse().unwrap();
            live.query = query.to_owned();
        }
        // What it says later is read, so that it does not wait.
        let later = live.later.clone();
        std::thread::spawn(move || {
            for line in said.lines() {
                *later.lock().unwrap() += &line.unwrap();
            }
        });
        live
    }

    fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        stream
            .set_read_timeout(Some(Duration::from_secs(20)))
            .unwrap();
        stream
    }

    /// Sends a request, and returns the whole answer.
    fn ask(&self, request: &[u8]) -> String {
        let mut stream = self.connect();
        // The server may answer, and close, before it has read all of a long request.
        let _ = stream.write_all(request);
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        String::from_utf8(answer).unwrap()
    }

    /// Sends an order as the page itself does, and returns the status of the answer.
    fn order(&self, order: &str) -> String {
        self.send(&format!("\"{order}\""))
    }

    /// Sends JSON as the page itself does, and returns the status of the answer.
    fn send(&self, json: &str) -> String {
        let own = format!("127.0.0.1:{}", self.port);
        let length = json.len();
        let request = format!(
            "POST /controls HTTP/1.1\r\nHost: {own}\r\nOrigin: http://{own}\r\nContent-Type: application/json\r\n\
             Content-Length: {length}\r\n\r\n{json}"
        );
        status(&self.ask(request.as_bytes())).to_owned()
    }

    fn get(&self, path: &str) -> String {
        self.ask(
            format!(
                "GET {path} HTTP/1.1\r\nHost: localhost:{}\r\n\r\n",
                self.port
            )
            .as_bytes(),
        )
    }

    /// Opens the stream of events, and reads the head of the answer.
    fn events(&self) -> Events {
        let mut stream = self.connect();
        write!(stream, "GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
        let mut events = Events(
            BufReader::new(stream),
            Instant::now() + Duration::from_secs(60),
        );
        assert!(events.lines().contains("text/event-stream"));
        events
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        self.program.kill().unwrap();
        self.program.wait().unwrap();
    }
}

/// A stream of events, and the time by which all awaited events must have come.
struct Events(BufReader<TcpStream>, Instant);

impl Events {
    /// Returns the lines up to an empty one.
    fn lines(&mut self) -> String {
        let mut lines = String::new();
        while !lines.ends_with("\n\n") && !lines.ends_with("\r\n\r\n") {
            assert!(Instant::now() < self.1, "what is waited for does not come");
            assert!(
                self.0.read_line(&mut lines).unwrap() > 0,
                "the stream ends: {lines}"
            );
        }
        lines
    }

    /// Returns the data of the next event of this name.
    fn next(&mut self, name: &str) -> Value {
        loop {
            let lines = self.lines();
            if let Some(rest) = lines.strip_prefix(&format!("event: {name}\ndata: ")) {
                return serde_json::from_str(rest).unwrap();
            }
        }
    }

    /// Returns the time and the values of the next row.
    fn row(&mut self) -> (u64, Vec<f32>) {
        loop {
            let lines = self.lines();
            if let Some((id, data)) = lines
                .strip_prefix("id: ")
                .and_then(|rest| rest.split_once("\ndata: "))
            {
                let bytes = BASE64_STANDARD.decode(data.trim()).unwrap();
                let values = bytes
                    .chunks(4)
                    .map(|four| f32::from_le_bytes(four.try_into().unwrap()));
                return (id.parse().unwrap(), values.collect());
            }
        }
    }
}

fn status(answer: &str) -> &str {
    answer.split(' ').nth(1).unwrap_or("nothing")
}

#[test]
fn a_live_page_is_fed_by_the_hands_that_play_and_says_what_a_file_says() {
    let folder = tempfile::tempdir().unwrap();
    let args = [
        "play", "--ckpt", "random", "--web", "0", "--hands", "2", "--plain", "--seed", "5",
    ];
    let live = Live::start(folder.path(), &[&args[..], &SHORT].concat());
    let page = live.get("/");
    assert!(status(&page) == "200" && page.contains("connect-src 'self'"));
    for header in [
        "Cache-Control: no-store",
        "X-Content-Type-Options: nosniff",
        "X-Frame-Options: DENY",
    ] {
        assert!(page.contains(header), "{header}");
    }
    assert!(!page.to_lowercase().contains("access-control"));
    let meta: Value = serde_json::from_str(block(&page, "meta")).unwrap();
    assert_eq!(
        (&meta["live"], &meta["hands"], &meta["every"], &meta["seed"]),
        (&json!(true), &json!(2), &json!(2), &json!("5"))
    );
    assert!(block(&page, "rows").is_empty());
    let mut events = live.events();
    let hello = events.next("hello");
    assert_eq!(hello["key"], meta["key"]);
    assert_eq!(hello["episodes"].as_array().unwrap().len(), 2);
    let (numbers, scalars) = (
        meta["numbers"].as_u64().unwrap() as usize,
        meta["scalars"].as_array().unwrap().len(),
    );
    let (first, row) = events.row();
    assert_eq!(row.len(), 2 * (numbers + scalars));
    assert!(row.iter().all(|x| x.is_finite()));
    let began = Instant::now();
    let mut last = (first, row.clone());
    for _ in 0..15 {
        last = events.row();
    }
    let passed = began.elapsed().as_secs_f64();
    assert!(last.0 > first && last.1 != row);
    assert!(
        passed > 0.1,
        "15 rows are 0.3 s, even if the machine had to catch up: {passed}"
    );
    // Each hand plays one episode after another, and each has a number.
    let mut seen = Vec::new();
    while seen.len() < 4 {
        seen.push(events.next("episode")["seed"].as_str().unwrap().to_owned());
    }
    seen.sort();
    assert_eq!(
        seen,
        [
            "5, episode 2",
            "5, episode 3",
            "5, episode 4",
            "5, episode 5"
        ]
    );
}

#[test]
fn who_comes_while_a_live_page_rests_sees_its_newest_row() {
    let folder = tempfile::tempdir().unwrap();
    let live = Live::start(
        folder.path(),
        &["play", "--ckpt", "random", "--web", "0", "--plain"],
    );
    let mut events = live.events();
    events.row();
    assert_eq!(live.order("pause"), "204");
    std::thread::sleep(Duration::from_millis(500));
    let rows = [(); 2].map(|()| {
        let mut late = live.events();
        late.next("hello");
        late.row()
    });
    assert_eq!(rows[0], rows[1]);
}

#[test]
fn a_slider_moves_an_actuator_and_only_the_page_can_move_it() {
    let folder = tempfile::tempdir().unwrap();
    let live = Live::start(folder.path(), &["view", "--web", "0", "--plain"]);
    let meta: Value = serde_json::from_str(block(&live.get("/"), "meta")).unwrap();
    let sliders = meta["sliders"].as_array().unwrap();
    assert_eq!(
        (sliders.len(), &sliders[3]["name"]),
        (20, &json!("rh_A_THJ2"))
    );
    let post = |more: &str, body: &str| {
        let host = format!("127.0.0.1:{}", live.port);
        let length = body.len();
        let request = format!(
            "POST /controls HTTP/1.1\r\nHost: {host}\r\nContent-Length: {length}\r\n{more}\r\n{body}"
        );
        status(&live.ask(request.as_bytes())).to_owned()
    };
    let own = format!(
        "Origin: http://127.0.0.1:{}\r\nContent-Type: application/json\r\n",
        live.port
    );
    let mut events = live.events();
    events.next("hello");
    let high = sliders[3]["high"].as_f64().unwrap();
    for (more, body, expected) in [
        (&own[..], "[[3,0.1]", "400"),
        (&own, "[[77,0.1]]", "400"),
        (&own, "[[3,1e999]]", "400"),
        (&own.replace("http://127", "http://128"), "[[3,9]]", "403"),
        (
            &own.replace("application/json", "text/plain"),
            "[[3,9]]",
            "403",
        ),
        ("Content-Type: application/json\r\n", "[[3,9]]", "403"),
        (
            &format!("{own}Transfer-Encoding: chunked\r\n"),
            "[[3,9]]",
            "411",
        ),
        (&own, &"7".repeat(5000), "413"),
        (&own, "[[3,9]]", "204"),
    ] {
        assert_eq!(post(more, body), expected, "{more}{body:.20}");
    }
    for (length, expected) in [
        ("+7", "411"),
        ("", "411"),
        ("7777777777777777777777", "413"),
    ] {
        let request = format!(
            "POST /controls HTTP/1.1\r\nHost: localhost\r\nContent-Length: {length}\r\n{own}\r\n[[3,9]]"
        );
        assert_eq!(status(&live.ask(request.as_bytes())), expected, "{length}");
    }
    assert_eq!(
        events.next("controls")[3].as_f64().unwrap(),
        high,
        "it is kept in its range"
    );
    assert_eq!(
        live.events().next("hello")["controls"][3].as_f64().unwrap(),
        high
    );
    assert_eq!(post(&own, "\"goal\""), "400", "it moves actuators only");
    // What `play` shows is touched by its own page only.
    let play = Live::start(
        folder.path(),
        &["play", "--ckpt", "zero", "--web", "0", "--plain"],
    );
    let request = format!(
        "POST /controls HTTP/1.1\r\nHost: localhost\r\n{own}Content-Length: 7\r\n\r\n[[3,9]]"
    );
    assert_eq!(status(&play.ask(request.as_bytes())), "403", "{request}");
    assert_eq!(play.order("goal"), "204");
}

#[test]
fn a_slider_changes_the_world_of_later_episodes_without_a_policy() {
    let folder = tempfile::tempdir().unwrap();
    for actor in ["zero", "random", "wave"] {
        let args = ["play", "--ckpt", actor, "--web", "0", "--plain"];
        let live = Live::start(folder.path(), &[&args[..], &SHORT].concat());
        let meta: Value = serde_json::from_str(block(&live.get("/"), "meta")).unwrap();
        let sliders = meta["sliders"].as_array().unwrap();
        let size = sliders
            .iter()
            .position(|slider| slider["name"].as_str().unwrap().starts_with("size"))
            .unwrap();
        let mut events = live.events();
        events.next("hello");
        assert_eq!(live.send(&format!("[[{size},1.2]]")), "204");
        for _ in 0..3 {
            events.next("episode");
        }
        let said = live.later.lock().unwrap();
        assert!(!said.contains("warning"), "{actor}: {said}");
    }
}

#[test]
fn behind_a_proxy_each_request_needs_the_token_of_the_printed_address_and_a_stream_ends() {
    let folder = tempfile::tempdir().unwrap();
    let view = ["view", "--web", "0", "--plain", "--web-host", "hub.example"];
    let live = Live::start(folder.path(), &view);
    let Live { port, query, .. } = &live;
    let token = query.strip_prefix("?access=").unwrap();
    assert!(token.len() == 32 && token.bytes().all(|c| c.is_ascii_hexdigit()));
    let other = Live::start(folder.path(), &view);
    assert_ne!(*query, other.query, "it is drawn anew");
    drop(other);

    let asked = |path: &str, host: &str, more: &str| {
        let mut stream = live.connect();
        write!(
            stream,
            "{path} HTTP/1.1\r\nHost: {host}\r\n{more}\r\n[[3,0.1]]"
        )
        .unwrap();
        let mut answer = [0; 12];
        stream.read_exact(&mut answer).unwrap();
        String::from_utf8_lossy(&answer[9..]).into_owned()
    };
    let sent =
        "Origin: https://hub.example\r\nContent-Type: application/json\r\nContent-Length: 9\r\n";
    for (path, host, more, expected) in [
        ("GET /", "hub.example", "", "403"),
        ("GET /", "localhost", "", "403"),
        ("GET /?access=", "hub.example", "", "403"),
        ("GET /events", "hub.example", "", "403"),
        ("POST /controls", "hub.example", sent, "403"),
        ("GET /TOKEN", "evil.example", "", "403"),
        ("GET /TOKEN", "hub.example", "", "200"),
        ("GET /TOKEN", "Hub.Example:8000", "", "200"),
        ("GET /TOKEN", "localhost", "", "200"),
        ("GET /node/n1/7070/TOKEN", "hub.example", "", "200"),
        (
            "GET /user/me/proxy/7070/eventsTOKEN",
            "hub.example",
            "",
            "200",
        ),
        (
            "GET /eventsTOKEN",
            "hub.example",
            "Sec-Fetch-Site: cross-site\r\n",
            "403",
        ),
        (
            "POST /node/n1/7070/controlsTOKEN",
            "hub.example",
            sent,
            "204",
        ),
        ("GET /otherTOKEN", "hub.example", "", "404"),
    ] {
        let path = path.replace("TOKEN", query);
        assert_eq!(asked(&path, host, more), expected, "{path} {host} {more}");
    }
    // A proxy may be on another machine.
    assert!(TcpStream::connect(("127.0.0.2", *port)).is_ok());
    let alone = Live::start(folder.path(), &view[..4]);
    assert!(alone.query.is_empty() && TcpStream::connect(("127.0.0.2", alone.port)).is_err());

    // A proxy may go on reading for somebody who has gone.
    let mut stream = live.connect();
    write!(
        stream,
        "GET /events{query} HTTP/1.1\r\nHost: hub.example\r\n\r\n"
    )
    .unwrap();
    let began = Instant::now();
    stream.read_to_end(&mut Vec::new()).unwrap();
    assert!((50..80).contains(&began.elapsed().as_secs()));
}

#[test]
fn a_page_of_another_site_takes_no_place_of_a_viewer() {
    let folder = tempfile::tempdir().unwrap();
    let live = Live::start(
        folder.path(),
        &["play", "--ckpt", "zero", "--web", "0", "--plain"],
    );
    for from in [
        "Origin: http://evil.example",
        "Origin: null",
        "Sec-Fetch-Site: cross-site\r\nOrigin: http://evil.example",
        "Sec-Fetch-Site: same-site",
    ] {
        let request = format!("GET /events HTTP/1.1\r\nHost: localhost\r\n{from}\r\n\r\n");
        assert_eq!(status(&live.ask(request.as_bytes())), "403", "{from}");
    }
    let mut own = live.connect();
    write!(
        own,
        "GET /events HTTP/1.1\r\nHost: localhost\r\nSec-Fetch-Site: same-origin\r\n\r\n"
    )
    .unwrap();
    let mut answer = [0; 12];
    own.read_exact(&mut answer).unwrap();
    assert!(answer.ends_with(b"200"));
}

#[test]
fn a_server_answers_what_is_no_request_of_its_page_and_serves_others_meanwhile() {
    let folder = tempfile::tempdir().unwrap();
    let live = Live::start(
        folder.path(),
        &["play", "--ckpt", "zero", "--web", "0", "--plain"],
    );
    let port = live.port;
    let taken = program(
        folder.path(),
        &["play", "--ckpt", "zero", "--web", &port.to_string()],
    );
    assert!(
        taken.status.code() == Some(1) && stderr(&taken).contains("choose another one"),
        "{}",
        stderr(&taken)
    );
    // Half a request, and one that never reads.
    let half: Vec<TcpStream> = (0..3)
        .map(|_| {
            let mut stream = live.connect();
            stream.write_all(b"GET / HTTP/1.1\r\nHos").unwrap();
            stream
        })
        .collect();
    let deaf: Vec<Events> = (0..2).map(|_| live.events()).collect();
    let local = "Host: localhost\r\n";
    for (line, headers, expected) in [
        ("GET / HTTP/1.1", "Host: evil.example\r\n", "403"),
        ("GET / HTTP/1.1", "", "403"),
        (
            "GET /events HTTP/1.1",
            "Host: localhost.evil.example\r\n",
            "403",
        ),
        ("GET /../../etc/passwd HTTP/1.1", local, "404"),
        ("GET /controls HTTP/1.1", local, "405"),
        (
            "POST / HTTP/1.1",
            "Host: localhost\r\nContent-Length: 0\r\n",
            "405",
        ),
        ("DELETE / HTTP/1.1", local, "405"),
        ("OPTIONS /events HTTP/1.1", local, "405"),
        ("GET / HTTP/3", local, "400"),
        ("nonsense", local, "400"),
        (
            "GET / HTTP/1.1",
            &format!("{local}X: {}\r\n", "x".repeat(9000)),
            "431",
        ),
    ] {
        let answer = live.ask(format!("{line}\r\n{headers}\r\n").as_bytes());
        assert_eq!(status(&answer), expected, "{line} {headers:.60}");
    }
    let mut readers: Vec<Events> = (0..6).map(|_| live.events()).collect();
    assert_eq!(
        status(&live.get("/events")),
        "503",
        "there are eight already"
    );
    readers.pop();
    let began = Instant::now();
    while status(&live.get("/")) != "200" || !live_reads(&live) {
        assert!(
            began.elapsed() < Duration::from_secs(10),
            "the place of a reader that has gone is free again"
        );
        std::thread::sleep(Duration::from_millis(100));
    }
    for mut stream in half {
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        assert_eq!(status(&answer), "408");
    }
    drop(deaf);
}

/// Returns whether another reader is accepted.
fn live_reads(live: &Live) -> bool {
    let mut stream = live.connect();
    write!(stream, "GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let mut answer = [0; 12];
    stream.read_exact(&mut answer).unwrap();
    answer.ends_with(b"200")
}

#[test]
fn a_training_is_followed_by_its_newest_policy_and_is_not_changed() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let ramp = [
        "--set",
        "env.act_moving_average={from=0.2,to=0.8,steps=200}",
    ];
    succeeded(program(
        folder,
        &train(&[&ramp[..], &["--total-steps", "128", "--run-dir", "run"]].concat()),
    ));
    let before = names(&folder.join("run"));
    let live = Live::start(
        folder,
        &["play", "--ckpt", "run", "--web", "0", "--follow", "--plain"],
    );
    let mut events = live.events();
    let first = events.next("hello")["episodes"][0]["policy"]
        .as_str()
        .unwrap()
        .to_owned();
    assert!(
        first.contains("latest.safetensors, 128 control steps"),
        "{first}"
    );
    assert_eq!(names(&folder.join("run")), before);
    succeeded(program(
        folder,
        &["train", "--resume", "run", "--total-steps", "256"],
    ));
    let began = Instant::now();
    while !events.next("episode")["policy"]
        .as_str()
        .unwrap()
        .ends_with("256 control steps, env.act_moving_average 0.8")
    {
        assert!(began.elapsed() < Duration::from_secs(20));
    }
    // A file that cannot be used is no reason to stop.
    fs::write(
        folder.join("run/checkpoints/latest.safetensors"),
        "nonsense",
    )
    .unwrap();
    for _ in 0..3 {
        assert!(
            events.next("episode")["policy"]
                .as_str()
                .unwrap()
                .contains("256 control steps")
        );
    }
    let alone = program(
        folder,
        &["play", "--ckpt", "builtin", "--web", "0", "--follow"],
    );
    assert!(
        alone.status.code() == Some(1) && stderr(&alone).contains("--follow needs a run"),
        "{}",
        stderr(&alone)
    );
}

#[test]
fn options_of_a_page_that_do_not_go_together_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for (args, part) in [
        (
            &["play", "--out", "x.html", "--episodes", "21"][..],
            "an HTML file shows at most 20 episodes, not 21",
        ),
        (
            &[
                "play",
                "--out",
                "x.html",
                "--episodes",
                "20",
                "--set",
                "env.max_episode_seconds=100",
            ],
            "at most 60000 steps",
        ),
        (
            &[
                "play",
                "--out",
                "x.html",
                "--set",
                "env.max_episode_seconds=1000",
            ],
            "episodes of at most 32767 steps",
        ),
        (
            &["play", "--out", "x.html", "--hands", "4"],
            "it applies only to a page in a browser (--web)",
        ),
        (
            &["play", "--out", "x.html", "--follow"],
            "--follow cannot be used with a score and an HTML file",
        ),
        (
            &["play", "--out", "x.html", "--quality", "high"],
            "--quality cannot be used with",
        ),
        (
            &["play", "--web", "--fps", "20"],
            "it applies only to a film or a picture (--out)",
        ),
        (&["play", "--web", "--json"], "cannot be used with"),
        (&["play", "--from-trace", "t.jsonl"], "--out"),
        (
            &[
                "play",
                "--from-trace",
                "t.jsonl",
                "--out",
                "x.html",
                "--seed",
                "3",
            ],
            "cannot be used with",
        ),
        (
            &["view", "--web", "--at", "3"],
            "--at cannot be used with a page in a browser",
        ),
        (&["view", "--web", "--out", "x.png"], "cannot be used with"),
        (
            &["view", "--check", "--out", "x.png"],
            "cannot be used with",
        ),
        (
            &["view", "--check", "--actions", "wave"],
            "cannot be used with",
        ),
        (
            &["view", "--web-host", "h", "--out", "x.png"],
            "it applies only to a page in a browser (--web)",
        ),
    ] {
        let output = program(folder.path(), args);
        let said = stderr(&output);
        assert!(
            output.status.code() != Some(0) && said.contains(part),
            "{args:?}: {part:?} is not in\n{said}"
        );
        assert!(names(folder.path()).is_empty());
    }
}
