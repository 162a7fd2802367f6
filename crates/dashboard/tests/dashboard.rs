//! The server as a browser meets it, over real connections, with real logs. What pages look like is `scripts/check-dashboard`'s.

#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_dashboard::{Dashboard, DashboardError, Editing, Known, MAX_LOGS, Options, Robots};
use ratn_executive::protocol::Mode;
use ratn_model::catalogue::Catalogue;
use ratn_model::load::load;
use ratn_motion::looks::Looks;
use ratn_motion::mesh::MeshError;
use ratn_motion::robot::Robot;
use ratn_task_control::control::RunStatus;
use ratn_worker::tls::ClientTls;
use serde_json::{Value, json};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::{TcpStream, UnixListener};
use tokio::sync::mpsc;

/// A name that would do something wherever it is taken for markup or code.
const INJECTED: &str = "<img src=x onerror=alert(1)></script><script>alert(2)</script>";

/// Whoever takes nothing for so long is cut off.
const PATIENCE: Duration = Duration::from_secs(1);

struct Served {
    address: String,
    token: String,
    _place: tempfile::TempDir,
}

struct Answer {
    status: u16,
    head: String,
    body: String,
}

impl Answer {
    fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap()
    }
}

fn options(logs: &[&Path], directory: &Path) -> Options {
    let logs = logs.iter().map(|path| path.to_path_buf()).collect();
    let robots = Robots::by(|_| Ok(known(Robot::aimm(), "the built-in robot")));
    Options { logs, robots, patience: PATIENCE, ..Options::of(directory.to_owned(), ClientTls::none()) }
}

fn known(robot: Robot, whence: &str) -> Known {
    Known { robot, looks: Looks::default(), whence: whence.to_owned() }
}

async fn serve(logs: &[&Path], control: bool) -> Served {
    let place = tempfile::tempdir().unwrap();
    let dashboard = Dashboard::bind(Options { control, ..options(logs, place.path()) }).await.unwrap();
    let url = dashboard.url();
    let (address, token) = url.strip_prefix("http://").unwrap().split_once("/#token=").unwrap();
    let served = Served { address: address.to_owned(), token: token.to_owned(), _place: place };
    tokio::spawn(dashboard.serve());
    served
}

impl Served {
    async fn say(&self, request: &str) -> Answer {
        let mut connection = TcpStream::connect(&self.address).await.unwrap();
        connection.write_all(request.as_bytes()).await.unwrap();
        let mut answer = Vec::new();
        let _ = connection.read_to_end(&mut answer).await;
        let answer = String::from_utf8_lossy(&answer);
        let (head, body) = answer.split_once("\r\n\r\n").unwrap_or((&answer, ""));
        let status = head.split(' ').nth(1).and_then(|status| status.parse().ok()).unwrap_or(0);
        Answer { status, head: head.to_lowercase(), body: body.to_owned() }
    }

    async fn ask(&self, method: &str, path: &str) -> Answer {
        let (address, token) = (&self.address, &self.token);
        self.say(&format!(
            "{method} {path} HTTP/1.1\r\nHost: {address}\r\nAuthorization: Bearer {token}\r\nConnection: close\r\n\r\n"
        ))
        .await
    }

    async fn get(&self, path: &str) -> Answer {
        self.ask("GET", path).await
    }

    /// The number of the only log.
    async fn log(&self) -> u64 {
        self.get("/api/about").await.json()["logs"][0]["id"].as_u64().unwrap()
    }

    /// Frames until there is no more.
    async fn frames(&self, query: &str) -> Vec<Value> {
        let (mut frames, mut epoch, mut version) = (Vec::new(), 0, 0);
        loop {
            let frame = self.get(&format!("/api/run?{query}&epoch={epoch}&version={version}")).await.json();
            (epoch, version) = (frame["epoch"].as_u64().unwrap(), frame["version"].as_u64().unwrap());
            let more = frame["more"].as_bool().unwrap();
            frames.push(frame);
            if !more {
                return frames;
            }
        }
    }
}

fn two_boxes() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../report/src/fixtures/two_boxes.jsonl")
}

fn log_of(lines: &[String]) -> tempfile::NamedTempFile {
    let mut file = tempfile::NamedTempFile::new().unwrap();
    for line in lines {
        writeln!(file, "{line}").unwrap();
    }
    file
}

fn started(task: &str) -> String {
    let task = serde_json::to_string(task).unwrap();
    format!(
        r#"{{"at":0,"event":"started","task":{task},"digest":"d","mode":"cdtn","parameters":{{}},"seed":1,"world":[],"revision":0,"capacity":{{"PathPlanner":1}}}}"#
    )
}

/// An instance that is expanded, runs for half a second and becomes real; a second each.
fn visit(id: u64) -> [String; 4] {
    let at = id * 1_000_000_000;
    let then = at + 500_000_000;
    [
        format!(
            r#"{{"at":{at},"command":"note","note":"expanded","instance":{id},"state":1,"path":"look[{id}]","speculative":false}}"#
        ),
        format!(
            r#"{{"at":{at},"command":"start","instance":{id},"attempt":1,"goal":{{"provider":"eye","action":"look","inputs":{{}},"seed":1,"lease":null,"projection":null,"expected_s":null}}}}"#
        ),
        format!(
            r#"{{"at":{then},"event":"finished","instance":{id},"attempt":1,"outcome":"success","outputs":{{}},"measured":[],"reason":""}}"#
        ),
        format!(r#"{{"at":{then},"command":"note","note":"retired","instance":{id}}}"#),
    ]
}

#[tokio::test]
async fn pages_run_nothing_of_others_and_are_had_by_this_machines_names_only() {
    let served = serve(&[&two_boxes()], false).await;
    for path in ["/", "/app.js", "/cell.js", "/app.css", "/icon.svg"] {
        let page = served.get(path).await;
        assert_eq!(page.status, 200, "{path}");
        assert!(page.head.contains("content-security-policy: default-src 'none'; script-src 'self'"), "{}", page.head);
        assert!(page.head.contains("x-content-type-options: nosniff") && page.head.contains("cache-control: no-store"));
        assert!(!page.body.contains(&served.token) && !page.body.contains("unsafe-"));
    }
    let address = &served.address;
    let rebound = served.say("GET / HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n").await;
    assert_eq!(rebound.status, 403);
    let posted = served.say(&format!("POST / HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")).await;
    assert_eq!(posted.status, 405);
}

#[tokio::test]
async fn nothing_is_told_without_the_token_nor_to_pages_of_others() {
    let served = serve(&[&two_boxes()], true).await;
    let (address, token) = (&served.address, &served.token);
    for (method, path) in [
        ("GET", "/api/about"),
        ("GET", "/api/run?log=1"),
        ("GET", "/api/robot?log=1"),
        ("GET", "/api/cell?log=1"),
        ("GET", "/api/system"),
        ("POST", "/api/control?log=1&word=abort"),
    ] {
        let head = format!("{method} {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n");
        assert_eq!(served.say(&format!("{head}\r\n")).await.status, 401, "{path}");
        assert_eq!(served.say(&format!("{head}Authorization: Bearer 0{token}\r\n\r\n")).await.status, 401, "{path}");
        // As a page of somebody else's would, had it the token.
        let foreign = format!("{head}Authorization: Bearer {token}\r\nOrigin: http://evil.example\r\n\r\n");
        assert_eq!(served.say(&foreign).await.status, 403, "{path}");
    }
    // A question before the question: what a browser asks whether another page may.
    let before = format!(
        "OPTIONS /api/about HTTP/1.1\r\nHost: {address}\r\nOrigin: http://evil.example\r\nConnection: close\r\n\r\n"
    );
    let answer = served.say(&before).await;
    assert!(answer.status == 403 && !answer.head.contains("access-control-"), "{}", answer.head);
}

#[tokio::test]
async fn a_run_is_told_once_and_then_what_has_changed() {
    let served = serve(&[&two_boxes()], false).await;
    let log = served.log().await;
    let first = &served.frames(&format!("log={log}")).await[0];
    assert_eq!((first["fresh"].as_bool(), first["run"]["controllable"].as_bool()), (Some(true), Some(false)));
    let instances = first["instances"].as_array().unwrap();
    assert!(
        instances.iter().any(|one| one["path"] == "fetch[1]/move" && one["state"] == "fetch/move"),
        "{instances:?}"
    );
    let waits = instances.iter().flat_map(|one| one["waits"].as_array().unwrap());
    assert!(
        waits
            .flat_map(|wait| wait["behind"].as_array().unwrap())
            .any(|behind| behind.as_str().unwrap().contains("/plan had path-planner"))
    );
    let edges: Vec<&str> = instances
        .iter()
        .flat_map(|one| one["edges"].as_array().unwrap())
        .filter_map(|edge| edge["kind"].as_str())
        .collect();
    assert!(edges.contains(&"data") && edges.contains(&"resource"), "{edges:?}");
    let (epoch, version) = (&first["epoch"], &first["version"]);
    let again = served.get(&format!("/api/run?log={log}&epoch={epoch}&version={version}")).await.json();
    assert_eq!((again["fresh"].as_bool(), again["instances"].as_array().unwrap().len()), (Some(false), 0));
}

#[tokio::test]
async fn a_log_that_grows_is_followed_and_tells_only_what_is_new() {
    let mut file = log_of(&[vec![started("grows")], visit(1).to_vec()].concat());
    let served = serve(&[file.path()], false).await;
    let log = served.log().await;
    let first = &served.frames(&format!("log={log}")).await[0];
    for line in visit(2) {
        writeln!(file, "{line}").unwrap();
    }
    tokio::time::sleep(Duration::from_millis(60)).await;
    let (epoch, version) = (&first["epoch"], &first["version"]);
    let next = served.get(&format!("/api/run?log={log}&epoch={epoch}&version={version}")).await.json();
    let told: Vec<&str> = next["instances"].as_array().unwrap().iter().filter_map(|one| one["path"].as_str()).collect();
    assert_eq!((told, next["fresh"].as_bool()), (vec!["look[2]"], Some(false)));
}

#[tokio::test]
async fn a_log_that_a_pipe_takes_the_place_of_is_refused_and_shown_again_when_it_is_back() {
    let place = tempfile::tempdir().unwrap();
    let (path, away) = (place.path().join("run.jsonl"), place.path().join("away.jsonl"));
    std::fs::write(&path, format!("{}\n", started("good"))).unwrap();
    let served = serve(&[&path], false).await;
    let question = format!("/api/run?log={}", served.log().await);
    assert_eq!(served.get(&question).await.json()["run"]["task"], "good");
    std::fs::rename(&path, &away).unwrap();
    assert!(std::process::Command::new("mkfifo").arg(&path).status().unwrap().success());
    for _ in 0..2 * MAX_LOGS {
        let refused = tokio::time::timeout(Duration::from_secs(20), served.get(&question)).await.expect("it hangs");
        assert!(refused.status == 422 && refused.body.contains("not a regular file"), "{}", refused.body);
    }
    std::fs::rename(&away, &path).unwrap();
    assert_eq!(served.get(&question).await.json()["run"]["task"], "good");
}

#[tokio::test]
async fn another_log_that_takes_the_place_of_one_is_read_anew() {
    let place = tempfile::tempdir().unwrap();
    let path = place.path().join("run.jsonl");
    let log = |task: &str, visits: u64| {
        let lines: Vec<String> = [vec![started(task)], (1..=visits).flat_map(visit).collect()].concat();
        lines.join("\n") + "\n"
    };
    std::fs::write(&path, log("one", 2)).unwrap();
    let served = serve(&[&path], false).await;
    let id = served.log().await;
    let (mut known, mut at) = (String::new(), String::new());
    // By another file of this name, in the same file, and of the same length.
    for (task, visits, by_name) in [("one", 2, true), ("two", 3, true), ("six", 3, false), ("ten", 9, false)] {
        match by_name {
            true => {
                std::fs::write(place.path().join("other"), log(task, visits)).unwrap();
                std::fs::rename(place.path().join("other"), &path).unwrap();
            }
            false => std::fs::write(&path, log(task, visits)).unwrap(),
        }
        tokio::time::sleep(Duration::from_millis(60)).await;
        for (moment, asked, instances) in [("", &mut known, visits), ("&at=2.6", &mut at, 2)] {
            let frame = served.get(&format!("/api/run?log={id}{moment}{asked}")).await.json();
            let told = frame["instances"].as_array().unwrap().len() as u64;
            assert_eq!((frame["run"]["task"].as_str(), told, &frame["fresh"]), (Some(task), instances, &true.into()));
            *asked = format!("&epoch={}&version={}", frame["epoch"], frame["version"]);
        }
    }
}

#[tokio::test]
async fn a_moment_is_shown_as_it_was_then_and_goes_on_from_there() {
    let lines: Vec<String> = [vec![started("replayed")], (1..=20).flat_map(visit).collect()].concat();
    let file = log_of(&lines);
    let served = serve(&[file.path()], false).await;
    let log = served.log().await;
    let at = |frame: &Value| (frame["run"]["at_s"].as_f64().unwrap(), frame["run"]["expanded"].as_u64().unwrap());
    let then = served.frames(&format!("log={log}&at=7.25")).await.pop().unwrap();
    assert_eq!(at(&then), (7.25, 7));
    assert_eq!(then["run"]["last_s"].as_f64(), Some(20.5));
    let running: Vec<&Value> =
        then["instances"].as_array().unwrap().iter().filter(|one| one["stage"] == "running").collect();
    assert_eq!(running.len(), 1);
    let (epoch, version) = (&then["epoch"], &then["version"]);
    let on = served.get(&format!("/api/run?log={log}&at=9.25&epoch={epoch}&version={version}")).await.json();
    assert_eq!((at(&on), on["fresh"].as_bool()), ((9.25, 9), Some(false)));
    let back = served.get(&format!("/api/run?log={log}&at=2&epoch={epoch}&version={}", on["version"])).await.json();
    assert_eq!((at(&back), back["fresh"].as_bool()), ((2.0, 2), Some(true)));
    // The newest is another fold, which no replay disturbs.
    assert_eq!(at(served.frames(&format!("log={log}")).await.last().unwrap()), (20.5, 20));
}

/// A motion of a joint of the arm from second `id` on, which lasts half of one.
fn motion(id: u64) -> [String; 2] {
    let (at, then) = (id * 1_000_000_000, id * 1_000_000_000 + 500_000_000);
    [
        format!(
            r#"{{"at":{at},"command":"start","instance":{id},"attempt":1,"goal":{{"provider":"arm","action":"follow","inputs":{{"trajectory":{{"trajectory":{{"joints":["arm_joint_1"],"points":[{{"time_s":0.0,"positions":[0.0],"velocities":[0.0]}},{{"time_s":0.5,"positions":[1.0],"velocities":[0.0]}}]}}}}}},"seed":1,"lease":null,"projection":null,"expected_s":null}}}}"#
        ),
        format!(
            r#"{{"at":{then},"event":"finished","instance":{id},"attempt":1,"outcome":"success","outputs":{{"end":{{"joints":[1.0]}}}},"measured":[],"reason":""}}"#
        ),
    ]
}

#[tokio::test]
async fn the_robot_is_told_once_and_where_its_joints_go_as_far_as_a_moment() {
    let lines: Vec<String> = [vec![started("moves")], (1..=5).flat_map(motion).collect()].concat();
    let file = log_of(&lines);
    let served = serve(&[file.path()], false).await;
    let log = served.log().await;
    let robot = served.get(&format!("/api/robot?log={log}")).await.json();
    assert_eq!((&robot["known"], &robot["name"]), (&Value::from(true), &Value::from("aimm")));
    let joint = robot["joints"].as_array().unwrap().iter().position(|one| one["name"] == "arm_joint_1").unwrap();
    let tracks = |cell: &Value| cell["tracks"].as_array().unwrap().len();
    let then = served.get(&format!("/api/cell?log={log}&at=2.25")).await.json();
    // The first motion, where it ended, and the second one, which goes on.
    assert_eq!((tracks(&then), then["at_s"].as_f64(), then["fits"].as_bool()), (3, Some(2.25), Some(true)));
    let last = &then["tracks"][2];
    assert_eq!((&last["joints"][0], &last["until_s"]), (&Value::from(joint), &Value::Null));
    assert_eq!(last["points"][1]["positions"][0].as_f64(), Some(1.0));
    // What goes on from there is told, and nothing else; it is the fold that the run's page has.
    let (epoch, version) = (&then["epoch"], &then["version"]);
    let on = served.get(&format!("/api/cell?log={log}&at=3.25&epoch={epoch}&version={version}")).await.json();
    assert_eq!((tracks(&on), on["fresh"].as_bool(), on["kept"].as_array().unwrap().len()), (3, Some(false), 5));
    let run = served.get(&format!("/api/run?log={log}&at=3.25&epoch={epoch}&version=0")).await.json();
    assert_eq!(run["epoch"], *epoch);
    assert_eq!(served.get(&format!("/api/cell?log={log}&at=soon")).await.status, 400);
    assert_eq!(served.get("/api/cell?log=99").await.status, 404);
    assert_eq!(served.ask("POST", &format!("/api/cell?log={log}")).await.status, 405);
}

#[tokio::test]
async fn each_log_is_shown_with_the_robot_that_it_names() {
    let place = tempfile::tempdir().unwrap();
    let of = |robot: &str| {
        log_of(&[started("seen").replace(r#","seed""#, &format!(r#","origin":{{"robot":"{robot}"}},"seed""#))])
    };
    let files = [of("ur5"), of("panda"), of("nobody"), log_of(&[started("earlier")])];
    let robots = Robots::by(|of_log| match of_log {
        "" => Ok(known(Robot::aimm(), "the built-in robot")),
        _ => {
            Robot::built_in(of_log).map(|robot| known(robot, "as the log says")).ok_or(format!("there is no {of_log}"))
        }
    });
    let paths: Vec<&Path> = files.iter().map(tempfile::NamedTempFile::path).collect();
    let dashboard = Dashboard::bind(Options { robots, ..options(&paths, place.path()) }).await.unwrap();
    let url = dashboard.url();
    let (address, token) = url.strip_prefix("http://").unwrap().split_once("/#token=").unwrap();
    let served = Served { address: address.to_owned(), token: token.to_owned(), _place: place };
    tokio::spawn(dashboard.serve());
    let logs = served.get("/api/about").await.json()["logs"].clone();
    let mut told = Vec::new();
    for log in logs.as_array().unwrap() {
        let robot = served.get(&format!("/api/robot?log={}", log["id"])).await.json();
        let cell = served.get(&format!("/api/cell?log={}", log["id"])).await.json();
        told.push(format!("{} {} {} {}", robot["known"], robot["name"], robot["note"], cell["fits"]));
    }
    assert_eq!(
        told,
        [
            r#"true "ur5" "as the log says" true"#,
            r#"true "panda" "as the log says" true"#,
            r#"false "" "there is no nobody" false"#,
            r#"true "aimm" "the built-in robot" true"#
        ]
    );
}

/// A built-in robot, and what would be seen of some of its links.
fn seen_robot(links: &str) -> Known {
    let looks = Looks::read(&format!("<robot name='seen'>{links}</robot>"), &mut |file| match file {
        "one.obj" => Ok(b"v 0 0 0\nv 2 0 0\nv 0 4 0\nf 1 2 3\n".to_vec()),
        _ => Err(MeshError::Read { reason: "there is no such file".to_owned() }),
    });
    Known { looks, ..known(Robot::built_in("panda").unwrap(), "as the log says") }
}

#[tokio::test]
async fn visuals_are_told_and_their_meshes_served_by_number_and_nothing_else() {
    let place = tempfile::tempdir().unwrap();
    let links: Vec<String> =
        Robot::built_in("panda").unwrap().model.links.iter().map(|link| link.name.clone()).collect();
    let [one, two, three] = [&links[0], &links[1], &links[2]];
    let visual = |geometry: &str| format!("<visual><origin xyz='1 0 0'/><geometry>{geometry}</geometry></visual>");
    let described = format!(
        "<link name='{one}'>{}{}</link><link name='{two}'>{}</link><link name='{three}'/>\
         <joint name='a' type='fixed'><parent link='{one}'/><child link='{two}'/></joint>\
         <joint name='b' type='fixed'><parent link='{one}'/><child link='{three}'/></joint>",
        visual("<mesh filename='one.obj' scale='1 1 2'/>"),
        visual("<sphere radius='0.5'/>")
            .replace("</visual>", "<material name='m'><color rgba='1 0.5 0 1'/></material></visual>"),
        visual("<mesh filename='/etc/passwd.stl'/>"),
    );
    let file = log_of(&[started("seen")]);
    let robots = Robots::by(move |_| Ok(seen_robot(&described)));
    let dashboard = Dashboard::bind(Options { robots, ..options(&[file.path()], place.path()) }).await.unwrap();
    let url = dashboard.url();
    let (address, token) = url.strip_prefix("http://").unwrap().split_once("/#token=").unwrap();
    let served = Served { address: address.to_owned(), token: token.to_owned(), _place: place };
    tokio::spawn(dashboard.serve());
    let log = served.log().await;

    let robot = served.get(&format!("/api/robot?log={log}")).await.json();
    let visuals = &robot["links"][0]["visuals"];
    let mesh = json!({ "shape": { "kind": "mesh", "size": [2.0, 4.0, 0.0], "at": { "position": [2.0, 2.0, 0.0], "quaternion": [0.0, 0.0, 0.0, 1.0] } }, "mesh": 0, "colour": null });
    assert_eq!(visuals[0], mesh);
    assert_eq!((&visuals[1]["colour"], &visuals[1]["shape"]["kind"]), (&json!([1.0, 0.5, 0.0]), &json!("sphere")));
    // Of what cannot be read that is drawn what can collide, and the page says so; of a link without visuals nothing is seen.
    assert_eq!(
        robot["lacks"],
        json!([format!("{two}: the mesh `/etc/passwd.stl`: cannot be read: there is no such file")])
    );
    let shapes = |link: usize| robot["links"][link]["shapes"].as_array().unwrap().clone();
    let seen = |link: usize| {
        robot["links"][link]["visuals"].as_array().unwrap().iter().map(|one| one["shape"].clone()).collect::<Vec<_>>()
    };
    assert!(!shapes(1).is_empty() && !shapes(2).is_empty());
    assert_eq!((seen(1), seen(2)), (shapes(1), vec![]));

    let corners = served.get(&format!("/api/mesh?log={log}&mesh=0")).await;
    assert_eq!(corners.status, 200);
    for header in ["content-type: application/octet-stream", "content-length: 36", "x-content-type-options: nosniff"] {
        assert!(corners.head.contains(header), "{}", corners.head);
    }
    for (query, status) in [
        (format!("log={log}&mesh=1"), 404),
        (format!("log={log}&mesh=18446744073709551616"), 400),
        (format!("log={log}&mesh=-1"), 400),
        (format!("log={log}&mesh=/etc/passwd.stl"), 400),
        (format!("log={log}"), 400),
        ("log=99&mesh=0".to_owned(), 404),
        ("mesh=0".to_owned(), 400),
    ] {
        assert_eq!(served.get(&format!("/api/mesh?{query}")).await.status, status, "{query}");
    }
    assert_eq!(served.ask("POST", &format!("/api/mesh?log={log}&mesh=0")).await.status, 405);
    let unknown =
        Served { token: "0".repeat(64), address: served.address.clone(), _place: tempfile::tempdir().unwrap() };
    assert_eq!(unknown.get(&format!("/api/mesh?log={log}&mesh=0")).await.status, 401);
}

#[tokio::test]
async fn without_a_robot_the_objects_are_told_and_why_it_is_not() {
    let place = tempfile::tempdir().unwrap();
    let world = r#"[[{"predicate":"shape","arguments":["box"]},{"map":{"type":{"string":"box"},"size":{"list":[{"float":0.1},{"float":0.2},{"float":0.3}]}}}],[{"predicate":"at","arguments":["box"]},{"pose":{"position":[1.0,0.0,0.5],"quaternion_xyzw":[0.0,0.0,0.0,1.0]}}]]"#;
    let file = log_of(&[started("seen").replace(r#""world":[]"#, &format!(r#""world":{world}"#))]);
    let robots = Robots::by(|_| Err("the robot `mine` is not known".to_owned()));
    let dashboard = Dashboard::bind(Options { robots, ..options(&[file.path()], place.path()) }).await.unwrap();
    let url = dashboard.url();
    let (address, token) = url.strip_prefix("http://").unwrap().split_once("/#token=").unwrap();
    let served = Served { address: address.to_owned(), token: token.to_owned(), _place: place };
    tokio::spawn(dashboard.serve());
    assert_eq!(served.get("/api/robot").await.status, 400);
    let log = served.log().await;
    assert_eq!(served.get(&format!("/api/robot?log={log}")).await.json()["known"], false);
    let cell = served.get(&format!("/api/cell?log={log}")).await.json();
    assert_eq!((&cell["fits"], &cell["note"]), (&Value::from(false), &Value::from("the robot `mine` is not known")));
    assert_eq!((&cell["objects"][0]["name"], &cell["truth"]), (&Value::from("box"), &Value::Null));
}

#[tokio::test]
async fn what_is_before_a_line_that_does_not_read_is_shown_and_the_line_is_named() {
    let lines = [vec![started("torn")], visit(1).to_vec(), vec!["{}".to_owned()], visit(2).to_vec()].concat();
    let file = log_of(&lines);
    let served = serve(&[file.path()], false).await;
    let log = served.log().await;
    let frame = served.frames(&format!("log={log}")).await.pop().unwrap();
    assert_eq!(frame["run"]["expanded"], 1);
    let problem = frame["run"]["problem"].as_str().unwrap();
    assert!(problem.contains(":6: not a line of an event log: it has no time `at`"), "{problem}");
}

#[tokio::test]
async fn of_a_long_log_what_is_shown_is_read() {
    // 60 MiB; each visit has a line of 256 KiB, as trajectories are.
    let ballast = "x".repeat(256 << 10);
    let visits = |id: u64| {
        let at = id * 1_000_000_000 + 1;
        let progress =
            format!(r#"{{"at":{at},"event":"progressed","instance":{id},"attempt":1,"message":"{ballast}"}}"#);
        visit(id).into_iter().take(2).chain([progress]).chain(visit(id).into_iter().skip(2))
    };
    let mut file = tempfile::NamedTempFile::new().unwrap();
    writeln!(file, "{}", started("long")).unwrap();
    for line in (1..=240).flat_map(visits) {
        writeln!(file, "{line}").unwrap();
    }
    let served = serve(&[file.path()], false).await;
    let log = served.log().await;
    let began = Instant::now();
    let first = served.get(&format!("/api/run?log={log}&at=200.25&epoch=0&version=0")).await.json();
    assert!(first["run"]["from_s"].as_f64().unwrap() > 100.0, "{}", first["run"]);
    assert_eq!((&first["run"]["task"], first["run"]["last_s"].as_f64()), (&Value::from("long"), Some(240.5)));
    let frames = served.frames(&format!("log={log}&at=200.25")).await;
    let run = &frames.last().unwrap()["run"];
    assert_eq!(run["at_s"].as_f64(), Some(200.25));
    assert!(began.elapsed() < Duration::from_secs(20), "{:?}", began.elapsed());
    // Who sees the cell or the world is told that what was before is not in it.
    for page in ["cell", "world"] {
        let told = served.get(&format!("/api/{page}?log={log}&at=200.25&epoch={}", frames[0]["epoch"])).await.json();
        assert_eq!(told["from_s"], run["from_s"], "{page}");
    }
    // A short moment after the start is read from the start.
    let early = served.frames(&format!("log={log}&at=3.25")).await.pop().unwrap();
    assert_eq!((early["run"]["from_s"].as_f64(), early["run"]["expanded"].as_u64()), (Some(0.0), Some(3)));
}

#[tokio::test]
async fn names_of_users_are_told_as_text_and_never_as_a_page() {
    let mut lines = vec![started(INJECTED)];
    let name = serde_json::to_string(INJECTED).unwrap();
    lines.push(format!(
        r#"{{"at":1,"command":"note","note":"expanded","instance":1,"state":1,"path":{name},"speculative":false}}"#
    ));
    lines.push(format!(r#"{{"at":2,"event":"world_changed","revision":1,"facts":[[{{"predicate":"at","arguments":[{name}]}},{{"string":{name}}}]]}}"#));
    let file = log_of(&lines);
    let served = serve(&[file.path()], false).await;
    let log = served.log().await;
    for path in [format!("/api/run?log={log}"), format!("/api/world?log={log}"), "/api/%3Cscript%3E".to_owned()] {
        let answer = served.get(&path).await;
        assert!(
            answer.head.contains("content-type: application/json") && answer.head.contains("nosniff"),
            "{}",
            answer.head
        );
        if path.contains("log=") {
            assert!(answer.body.contains(&name[1..20]), "{}", answer.body);
        }
    }
    let world = served.get(&format!("/api/world?log={log}")).await.json();
    assert_eq!(world["facts"][0]["writer"], "somebody else");
    assert_eq!(world["facts"][0]["value"], INJECTED);
}

#[tokio::test]
async fn pages_only_look_unless_their_user_said_otherwise() {
    let served = serve(&[&two_boxes()], false).await;
    let refused = served.ask("POST", "/api/control?log=1&word=pause").await;
    assert_eq!(refused.status, 403);
    assert!(refused.json()["problem"].as_str().unwrap().contains("--control"), "{}", refused.body);
    assert_eq!(served.ask("POST", "/api/scale?host=h&template=t&min=0").await.status, 403);
    assert_eq!(served.ask("POST", "/api/control?log=1&word=break&state=a").await.status, 403);
    let served = serve(&[&two_boxes()], true).await;
    let log = served.log().await;
    for (path, status) in [
        (format!("/api/control?log={log}&word=pause"), 409),
        (format!("/api/control?log={log}&word=fly"), 400),
        ("/api/control?word=pause".to_owned(), 409),
        (format!("/api/control?log={log}&word=answer&state=a&choice=b"), 409),
        (format!("/api/control?log={log}&word=signal&signal=a"), 409),
        (format!("/api/control?log={log}&word=break&state=a"), 409),
        (format!("/api/control?log={log}&word=break"), 400),
        (format!("/api/control?log={log}&word=clear"), 409),
        ("/api/scale?host=h&template=t&min=-1".to_owned(), 400),
        ("/api/scale?host=h&template=t&min=1".to_owned(), 409),
    ] {
        assert_eq!(served.ask("POST", &path).await.status, status, "{path}");
    }
    // A link or an image cannot do it.
    assert_eq!(served.get(&format!("/api/control?log={log}&word=pause")).await.status, 405);
}

/// A run as far as its control socket shows: it says what it is doing, and takes what it is sent.
async fn listen(listener: UnixListener, status: RunStatus, taken: mpsc::Sender<String>) {
    while let Ok((mut connection, _)) = listener.accept().await {
        let (reader, mut writer) = connection.split();
        let mut line = String::new();
        // Whoever only looks whether a run listens says nothing.
        if BufReader::new(reader).read_line(&mut line).await.is_err() || line.is_empty() {
            continue;
        }
        let answer = if line.trim() == "status" {
            serde_json::to_string(&status).unwrap()
        } else {
            taken.send(line.trim().to_owned()).await.unwrap();
            "ok the run pauses before that".to_owned()
        };
        writer.write_all(format!("{answer}\n").as_bytes()).await.unwrap();
    }
}

#[tokio::test]
async fn breakpoints_are_told_as_a_run_has_them_and_set_and_cleared_in_it() {
    let place = tempfile::tempdir().unwrap();
    let log = place.path().join("run.jsonl");
    let lines = [
        started("stops").replace(r#""capacity""#, r#""breakpoints":["early"],"capacity""#),
        r#"{"at":1000000000,"command":"note","note":"expanded","instance":1,"state":1,"path":"late[2]","speculative":false}"#.to_owned(),
        r#"{"at":2000000000,"event":"breakpoints_set","states":["late"]}"#.to_owned(),
        r#"{"at":3000000000,"command":"note","note":"stopped","instance":1}"#.to_owned(),
    ];
    std::fs::write(&log, lines.join("\n") + "\n").unwrap();
    let dashboard = Dashboard::bind(Options { control: true, ..options(&[&log], place.path()) }).await.unwrap();
    let url = dashboard.url();
    let (address, token) = url.strip_prefix("http://").unwrap().split_once("/#token=").unwrap();
    let served = Served { address: address.to_owned(), token: token.to_owned(), _place: tempfile::tempdir().unwrap() };
    tokio::spawn(dashboard.serve());
    let id = served.log().await;
    let run = async |moment: &str| served.get(&format!("/api/run?log={id}{moment}")).await.json()["run"].clone();
    for (moment, breakpoints, paused, stopped_at) in [
        ("&at=1.5", json!(["early"]), false, Value::Null),
        ("&at=2.5", json!(["late"]), false, Value::Null),
        ("", json!(["late"]), true, json!("late[2]")),
    ] {
        let told = run(moment).await;
        assert_eq!((&told["breakpoints"], &told["stopped_at"]), (&breakpoints, &stopped_at), "{moment}");
        assert_eq!(told["paused"], paused, "{moment}");
    }

    // A run that goes on knows better than what was read of its log.
    let listener = UnixListener::bind(place.path().join("run-1.control")).unwrap();
    let status = RunStatus {
        run: "run-1".to_owned(),
        task: "stops".to_owned(),
        mode: Mode::Cdtn,
        log: log.clone(),
        at_s: 4.0,
        share: 1.0,
        due_in_s: None,
        paused: true,
        ended: 0,
        under_way: Vec::new(),
        waits: Vec::new(),
        awaits: Vec::new(),
        breakpoints: vec![INJECTED.to_owned(), "late".to_owned()],
    };
    let (taken, mut told) = mpsc::channel(4);
    tokio::spawn(listen(listener, status, taken));
    while served.get("/api/about").await.json()["logs"][0]["live"] != true {}
    assert_eq!(run("").await["breakpoints"], json!([INJECTED, "late"]), "as text");
    assert_eq!(run("&at=1.5").await["breakpoints"], json!(["early"]), "a replay shows those of its moment");
    for (question, message) in [
        (
            "word=break&state=for_box%2Fgrasp",
            r#"{"message":"breakpoint","run":"run-1","state":"for_box/grasp","set":true}"#,
        ),
        ("word=clear&state=late", r#"{"message":"breakpoint","run":"run-1","state":"late","set":false}"#),
        ("word=clear", r#"{"message":"breakpoint","run":"run-1","state":null,"set":false}"#),
    ] {
        let answer = served.ask("POST", &format!("/api/control?log={id}&{question}")).await;
        assert_eq!(
            (answer.status, answer.json()["said"].as_str()),
            (200, Some("the run pauses before that")),
            "{question}"
        );
        assert_eq!(told.recv().await.as_deref(), Some(message));
    }
    assert!(told.try_recv().is_err(), "nothing else was said to the run");
}

#[tokio::test]
async fn what_cannot_be_shown_is_said() {
    let place = tempfile::tempdir().unwrap();
    let exposed = Options { address: "0.0.0.0:0".parse().unwrap(), ..options(&[], place.path()) };
    assert!(matches!(Dashboard::bind(exposed).await, Err(DashboardError::Exposed { .. })));
    let log = two_boxes();
    let many = Dashboard::bind(options(&vec![log.as_path(); MAX_LOGS + 1], place.path())).await.unwrap_err();
    assert_eq!(many.to_string(), "17 logs are more than the 16 that are looked at at once: name fewer");
    let missing = Dashboard::bind(options(&[Path::new("/nowhere/run.jsonl")], place.path())).await.unwrap_err();
    assert!(matches!(missing, DashboardError::NoLog { .. }));
    let foreign = log_of(&["no log".to_owned()]);
    assert!(matches!(Dashboard::bind(options(&[foreign.path()], place.path())).await, Err(DashboardError::Log(_))));
    let served = serve(&[&log], false).await;
    assert_eq!(served.get("/api/run?log=99").await.status, 404);
    assert_eq!(served.get("/api/run").await.status, 400);
    let id = served.log().await;
    for moment in ["soon", "-1", "inf", "NaN"] {
        assert_eq!(served.get(&format!("/api/run?log={id}&at={moment}")).await.status, 400, "{moment}");
    }
    assert_eq!(served.get("/api/nothing").await.status, 404);
    let system = served.get("/api/system").await.json();
    assert_eq!(system["up"], false);
    assert!(!system["problem"].as_str().unwrap().is_empty());
}

#[tokio::test]
async fn who_has_the_token_is_answered_beside_a_crowd_that_says_nothing() {
    let file = log_of(&[started("crowded")]);
    let served = serve(&[file.path()], false).await;
    let mut crowd = Vec::new();
    for _ in 0..150 {
        crowd.push(TcpStream::connect(&served.address).await.unwrap());
    }
    assert_eq!(served.get("/api/about").await.status, 200);
    drop(crowd);
}

#[tokio::test]
async fn a_pipe_is_no_log_and_is_not_waited_for() {
    let place = tempfile::tempdir().unwrap();
    let pipe = place.path().join("pipe.jsonl");
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let refused = Dashboard::bind(options(&[&pipe], place.path())).await.unwrap_err();
    let DashboardError::Log(refused) = refused else { panic!("{refused}") };
    let why = std::error::Error::source(&refused).unwrap().to_string();
    assert!(why.starts_with("not a regular file"), "{why}");
}

#[tokio::test]
async fn a_browser_that_reads_nothing_is_cut_off_and_others_go_on() {
    let lines: Vec<String> = [vec![started("wide")], (1..=3_000).flat_map(visit).collect()].concat();
    let file = log_of(&lines);
    let served = serve(&[file.path()], false).await;
    let log = served.log().await;
    let mut slow = TcpStream::connect(&served.address).await.unwrap();
    let (address, token) = (&served.address, &served.token);
    let question =
        format!("GET /api/run?log={log} HTTP/1.1\r\nHost: {address}\r\nAuthorization: Bearer {token}\r\n\r\n");
    // Answers of a megabyte each, which it does not read, until nobody takes its questions any more.
    let began = Instant::now();
    while slow.write_all(question.as_bytes()).await.is_ok() {
        assert!(began.elapsed() < Duration::from_secs(60), "it is not cut off");
        assert_eq!(served.get("/api/about").await.status, 200);
        tokio::time::sleep(PATIENCE / 10).await;
    }
    assert!(began.elapsed() >= PATIENCE, "it was given no time: {:?}", began.elapsed());
}

const TASK: &str = "\
task: <img>
states:
  - plan: # it plans
      action: path_planner/plan
      in: { start: \"joints(0, 0, 0, 0, 0, 0, 0)\", goal: \"joints(1, 0, 0, 0, 0, 0, 0)\" }
      duration: 2
";

/// A dashboard with a task file that may be changed.
async fn serve_editor() -> (Served, PathBuf) {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("task.yaml");
    std::fs::write(&file, TASK).unwrap();
    let check = |text: &str| load(text, "task.yaml", &Catalogue::standard());
    let edit = Some(Editing::of(file.clone(), || vec!["Arm".to_owned()], check, |_, _| Ok(7.5)));
    let dashboard = Dashboard::bind(Options { edit, ..options(&[], place.path()) }).await.unwrap();
    let url = dashboard.url();
    let (address, token) = url.strip_prefix("http://").unwrap().split_once("/#token=").unwrap();
    let served = Served { address: address.to_owned(), token: token.to_owned(), _place: place };
    tokio::spawn(dashboard.serve());
    (served, file)
}

impl Served {
    async fn post(&self, path: &str, more: &str, body: &str) -> Answer {
        let (address, length) = (&self.address, body.len());
        self.say(&format!(
            "POST {path} HTTP/1.1\r\nHost: {address}\r\n{more}Content-Length: {length}\r\nConnection: close\r\n\r\n{body}"
        ))
        .await
    }

    fn shown_token(&self) -> String {
        format!("Authorization: Bearer {}\r\n", self.token)
    }
}

fn change(digest: &Value, items: &str) -> String {
    format!(r#"{{"digest":{digest},"state":"plan","changes":[{{"key":"duration","items":{items}}}]}}"#)
}

#[tokio::test]
async fn without_a_task_file_to_change_nothing_of_the_editor_is_there() {
    let served = serve(&[], true).await;
    assert_eq!(served.get("/api/about").await.json()["edit"], "");
    assert_eq!(served.get("/api/annotations").await.status, 404);
    for path in ["check", "gain", "save"] {
        assert_eq!(served.post(&format!("/api/annotations/{path}"), &served.shown_token(), "{}").await.status, 404);
    }
}

#[tokio::test]
async fn annotations_are_checked_without_being_written_and_written_once_the_page_says_so() {
    let (served, file) = serve_editor().await;
    let on_disk = || std::fs::read_to_string(&file).unwrap();
    let told = served.get("/api/annotations").await.json();
    assert_eq!((&told["states"][0]["path"], &told["kinds"][0]), (&Value::from("plan"), &Value::from("Arm")));
    let (digest, token) = (&told["digest"], served.shown_token());
    let checked = served.post("/api/annotations/check", &token, &change(digest, r#"["3.5"]"#)).await.json();
    assert_eq!((&checked["refused"], &checked["after"][0]), (&Value::from(false), &Value::from("      duration: 3.5")));
    let gained = served.post("/api/annotations/gain", &token, &change(digest, r#"["3.5"]"#)).await.json();
    assert_eq!((gained["before_s"].as_f64(), gained["after_s"].as_f64()), (Some(7.5), Some(7.5)));
    assert_eq!(on_disk(), TASK);
    let saved = served.post("/api/annotations/save", &token, &change(digest, r#"["3.5"]"#)).await;
    assert_eq!(saved.status, 200, "{}", saved.body);
    assert_eq!(on_disk(), TASK.replace("duration: 2", "duration: 3.5"));
    // The page has seen another text than is there now.
    let again = served.post("/api/annotations/save", &token, &change(digest, "null")).await;
    assert!(again.status == 409 && again.body.contains("read it again"), "{}", again.body);
    assert_eq!(on_disk(), TASK.replace("duration: 2", "duration: 3.5"));
}

#[tokio::test]
async fn nothing_is_written_without_the_token_for_pages_of_others_by_get_or_from_what_is_too_long() {
    let (served, file) = serve_editor().await;
    let (digest, token) = (served.get("/api/annotations").await.json()["digest"].clone(), served.shown_token());
    let (path, good) = ("/api/annotations/save", change(&digest, "null"));
    assert_eq!(served.post(path, "", &good).await.status, 401);
    let foreign = format!("{token}Origin: http://evil.example\r\n");
    assert_eq!(served.post(path, &foreign, &good).await.status, 403);
    assert_eq!(served.post(path, &format!("{token}Sec-Fetch-Site: cross-site\r\n"), &good).await.status, 403);
    assert_eq!(served.get(path).await.status, 405);
    assert_eq!(served.ask("POST", "/api/annotations").await.status, 405);
    let long = change(&digest, &format!("[\"{}\"]", "x".repeat(70_000)));
    assert_eq!(served.post(path, &token, &long).await.status, 413);
    for odd in ["", "[]", "{}", &change(&Value::from(7), "null"), &change(&digest, r#"null,"more":1"#)] {
        assert_eq!(served.post(path, &token, odd).await.status, 400, "{odd}");
    }
    for (state, key, status) in [("nowhere", "reads", 422), ("plan", "action", 422), ("plan", "pia", 422)] {
        let body = format!(r#"{{"digest":{digest},"state":"{state}","changes":[{{"key":"{key}","items":[]}}]}}"#);
        assert_eq!(served.post(path, &token, &body).await.status, status, "{state} {key}");
    }
    assert_eq!(std::fs::read_to_string(&file).unwrap(), TASK);
    // A body that does not come keeps nobody waiting for ever.
    let (address, begun) = (&served.address, Instant::now());
    let slow =
        format!("POST {path} HTTP/1.1\r\nHost: {address}\r\n{token}Content-Length: 9\r\nConnection: close\r\n\r\n{{");
    assert_eq!(served.say(&slow).await.status, 408);
    assert!(begun.elapsed() < 10 * PATIENCE);
}
