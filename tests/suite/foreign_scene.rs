//! Scenes of users with what MuJoCo accepts and the task does not.

use std::fs;

use shadow_repose::repose::Task;
use shadow_repose::sim::{Compilation, Cone, Scene};

use crate::support::{SCENE, config};

/// Returns the built-in scene with these texts replaced.
#[track_caller]
fn edited(edits: &[(&str, &str)]) -> String {
    edits.iter().fold(SCENE.to_owned(), |text, (from, to)| {
        assert!(text.contains(from), "{from}");
        text.replacen(from, to, 1)
    })
}

/// Fails unless the scene with these texts replaced is refused with this part of a message.
#[track_caller]
fn refused(edits: &[(&str, &str)], part: &str) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("own.xml");
    fs::write(&path, edited(edits)).unwrap();
    let model = format!("env.model={}", path.display());
    let message = Task::new(&config(&[&model]))
        .err()
        .map(|error| format!("{error:#}"));
    assert!(
        message
            .as_ref()
            .is_some_and(|message| message.contains(part)),
        "{part}: {message:?}"
    );
}

const SERVO: &str = "<position name=\"rh_A_FFJ3\" class=\"hand\" joint=\"rh_FFJ3\"/>";

#[test]
fn a_height_that_is_no_number_is_named() {
    let field = "<asset><hfield name=\"hills\" nrow=\"3\" ncol=\"3\" size=\"1 1 .1 .1\" elevation=\"0 0 0 0 nan 0 0 0 1\"/>";
    let geom = "<worldbody><geom type=\"hfield\" hfield=\"hills\" pos=\"0 0 -1\"/>";
    refused(
        &[("<asset>", field), ("<worldbody>", geom)],
        "hfield_data of hfield `hills` is not a finite number",
    );
}

#[test]
fn a_servo_with_a_constant_force_is_none() {
    // MuJoCo itself takes a positive third number for a damping ratio.
    let servo = "<general name=\"rh_A_FFJ3\" joint=\"rh_FFJ3\" ctrlrange=\"-.2 1.5\" gaintype=\"fixed\" gainprm=\"1\" \
                 biastype=\"affine\" biasprm=\".5 -1 0\"/>";
    refused(&[(SERVO, servo)], "`rh_A_FFJ3` must be a position servo");
}

#[test]
fn servos_and_contacts_that_the_scene_disables_are_named() {
    let disabled = (
        "<flag island=\"disable\"/>",
        "<flag island=\"disable\" actuation=\"disable\"/>",
    );
    refused(&[disabled], "actuation must not be disabled");
    for flag in ["contact", "constraint"] {
        let to = format!("<flag island=\"disable\" {flag}=\"disable\"/>");
        refused(
            &[("<flag island=\"disable\"/>", &to)],
            &format!("{flag} must not be disabled"),
        );
    }
    let grouped = SERVO.replace("/>", " group=\"4\"/>");
    let option = ("<option ", "<option actuatorgroupdisable=\"4\" ");
    refused(
        &[(SERVO, &grouped), option],
        "`rh_A_FFJ3` must not be disabled by its group 4",
    );
}

#[test]
fn a_name_that_is_not_utf_8_is_refused_whatever_it_is_the_name_of() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("own.xml");
    let model = format!("env.model={}", path.display());
    let more = "<worldbody><light name=\"~\"/><camera name=\"~\"/><site name=\"~\"/><geom name=\"~\" size=\".1\"/>";
    let cases = [
        ("name=\"cube\"", "name=\"cube~\""),
        ("<worldbody>", more),
        (
            "<actuator>",
            "<custom><text name=\"~\" data=\"x\"/></custom><actuator>",
        ),
        (
            "<actuator>",
            "<keyframe><key name=\"~\"/></keyframe><actuator>",
        ),
        (
            "<actuator>",
            "<equality><joint name=\"~\" joint1=\"rh_FFJ1\"/></equality><actuator>",
        ),
        ("<mujoco model=\"", "<mujoco model=\"~"),
    ];
    for (from, to) in cases {
        let text = edited(&[(from, to)]);
        for (byte, is_text) in [
            (&b"\xe9"[..], false),
            (b"&#xD800;", false),
            ("é".as_bytes(), true),
        ] {
            let parts: Vec<&[u8]> = text.split('~').map(str::as_bytes).collect();
            fs::write(&path, parts.join(byte)).unwrap();
            let said = Task::new(&config(&[&model]))
                .err()
                .map(|error| format!("{error:#}"));
            let said = said.unwrap_or_default();
            assert_eq!(!said.contains("is not UTF-8"), is_text, "{to}: {said}");
        }
    }
}

#[test]
fn a_pipe_or_a_device_in_a_scene_is_refused_before_mujoco_waits_for_it() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::create_dir(folder.join("inner")).unwrap();
    let made = std::process::Command::new("mkfifo")
        .args(["pipe", "inner/pipe"])
        .current_dir(folder)
        .status();
    assert!(made.unwrap().success());
    fs::write(
        folder.join("inner/more.xml"),
        "<mujoco><include file=\"inner/pipe\"/></mujoco>",
    )
    .unwrap();
    let compiler = "autolimits=\"true\"/>";
    let within = |attribute: &str| format!("autolimits=\"true\" {attribute}/>");
    for (from, to) in [
        (compiler, format!("{compiler}<include file=\"pipe\"/>")),
        (compiler, format!("{compiler}<include file=\"/dev/zero\"/>")),
        (
            compiler,
            format!("{compiler}<include file=\"inner/more.xml\"/>"),
        ),
        ("<asset>", "<asset><mesh name=\"m\" file = 'pipe'/>".into()),
        ("<asset>", "<asset><model name=\"m\" file=\"pipe\"/>".into()),
        (
            compiler,
            format!(
                "{}<asset><mesh file=\"pipe\"/></asset>",
                within("meshdir=\"inner\"")
            ),
        ),
        (
            compiler,
            format!(
                "{}<asset><texture type=\"cube\" fileup=\"x/pipe\"/></asset>",
                within("texturedir=\"inner\" strippath=\"true\"")
            ),
        ),
    ] {
        let path = folder.join("own.xml");
        fs::write(&path, edited(&[(from, &to)])).unwrap();
        let said = Scene::load(Some(&path), &Compilation::plain(0.01, Cone::Scene));
        let said = format!("{:#}", said.err().expect("it is refused"));
        assert!(said.contains("is a pipe or a device"), "{to}: {said}");
    }
    // What stands in a comment is not read.
    let path = folder.join("own.xml");
    let comment = "<!-- <a/> <include file=\"pipe\"/> --><worldbody>";
    fs::write(&path, edited(&[("<worldbody>", comment)])).unwrap();
    Scene::load(Some(&path), &Compilation::plain(0.01, Cone::Scene)).unwrap();
}

#[test]
fn the_fingerprint_sees_servos_pairs_and_limits_and_that_of_the_builtin_scene_stays() {
    let folder = tempfile::tempdir().unwrap();
    let plain = Compilation::plain(0.01, Cone::Scene);
    let print = |edits: &[(&str, &str)]| {
        let path = folder.path().join("own.xml");
        fs::write(&path, edited(edits)).unwrap();
        Scene::load(Some(&path), &plain).unwrap().fingerprint()
    };
    let builtin = Scene::load(None, &plain).unwrap().fingerprint();
    // Checkpoints hold this one. On ARM, MuJoCo computes other last bits of inertias.
    if cfg!(target_arch = "x86_64") {
        assert_eq!(builtin, "bdf8dcb5");
    }
    assert_eq!(print(&[]), builtin);
    // How MuJoCo stores Jacobians changes no motion.
    assert_eq!(
        print(&[("jacobian=\"sparse\"", "jacobian=\"dense\"")]),
        builtin
    );
    for servo in ["armature=\".01\"", "damping=\".1\""] {
        let own = SERVO.replace("/>", &format!(" {servo}/>"));
        assert_ne!(print(&[(SERVO, &own)]), builtin, "{servo}");
    }
    for limit in [
        "solreflimit=\".05 1\"",
        "solimplimit=\".8 .9 .001\"",
        "margin=\".1\"",
    ] {
        let tendon = format!("<fixed name=\"rh_FFJ0\" limited=\"true\" range=\"0 3\" {limit}>");
        let usual = "<fixed name=\"rh_FFJ0\" limited=\"true\" range=\"0 3\">";
        let from = "<fixed name=\"rh_FFJ0\">";
        assert_ne!(
            print(&[(from, &tendon)]),
            print(&[(from, usual)]),
            "{limit}"
        );
    }
    let forces = [".1", ".2"].map(|most| {
        let tendon = format!(
            "<fixed name=\"rh_FFJ0\" actuatorfrclimited=\"true\" actuatorfrcrange=\"-{most} {most}\">"
        );
        print(&[("<fixed name=\"rh_FFJ0\">", &tendon)])
    });
    assert_ne!(forces[0], forces[1]);
    let ball = |size: &str| {
        format!(
            "<worldbody><geom name=\"ball\" type=\"sphere\" size=\"{size}\" contype=\"0\" conaffinity=\"0\"/>"
        )
    };
    let pair = (
        "</worldbody>",
        "</worldbody><contact><pair geom1=\"ball\" geom2=\"cube\"/></contact>",
    );
    let with = |size: &str, paired: bool| {
        let ball = ball(size);
        let edits = [("<worldbody>", &ball[..]), pair];
        print(&edits[..if paired { 2 } else { 1 }])
    };
    assert_eq!(with(".1", false), with(".2", false));
    assert_ne!(with(".1", true), with(".2", true));
}

#[test]
fn a_file_of_the_same_name_elsewhere_does_not_serve_in_place_of_one_that_a_scene_names() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let corners = |size: f64| {
        format!(
            "v 0 0 0\nv {size} 0 0\nv 0 {size} 0\nv 0 0 {size}\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
        )
    };
    fs::write(folder.join("x.obj"), corners(1.0)).unwrap();
    let path = folder.join("s.xml");
    let model = format!("env.model={}", path.display());
    let weighed = |mesh: &str| {
        let asset = format!("<asset><mesh name=\"m\" file=\"{mesh}\"/>");
        let body = "<worldbody><body pos=\"9 9 9\"><geom type=\"mesh\" mesh=\"m\"/></body>";
        fs::write(&path, edited(&[("<asset>", &asset), ("<worldbody>", body)])).unwrap();
        anyhow::Ok(Task::new(&config(&[&model]))?.scene.fingerprint())
    };
    let refused = format!("{:#}", weighed("own/x.obj").unwrap_err());
    assert!(refused.contains("own/x.obj"), "{refused}");
    fs::create_dir(folder.join("own")).unwrap();
    for name in ["own/x.obj", "own/y.obj"] {
        fs::write(folder.join(name), corners(2.0)).unwrap();
    }
    let expected = weighed("own/y.obj").unwrap();
    assert_ne!(weighed("x.obj").unwrap(), expected);
    assert_eq!(weighed("own/x.obj").unwrap(), expected);
}
