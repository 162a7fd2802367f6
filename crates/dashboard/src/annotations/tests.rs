#![allow(clippy::unwrap_used, reason = "a test may panic")]
use super::*;
use ratn_model::catalogue::Catalogue;
use ratn_model::load::{Files, load, load_with};
use std::os::unix::fs::PermissionsExt;

const TASK: &str = "\
task: t
states:
  - plan: # it plans
      action: path_planner/plan
      in: { start: \"joints(0, 0, 0, 0, 0, 0, 0)\", goal: \"joints(1, 0, 0, 0, 0, 0, 0)\" }
      duration: 2
  - open: { action: gripper/release, retry: 1, effects: { success: [hand_empty(gripper)], aborted: [] } }
";

fn editing(folder: &tempfile::TempDir) -> Editing {
    let file = folder.path().join("t.yaml");
    std::fs::write(&file, TASK).unwrap();
    let check = |text: &str| load(text, "t.yaml", &Catalogue::standard());
    let makespan = |program: &Program, _: &dyn Fn() -> bool| Ok(program.states.len() as f64);
    Editing::of(file, || vec!["Arm".to_owned()], check, makespan)
}

fn proposal(editing: &Editing, state: &str, key: &str, items: Option<&[&str]>) -> Proposal {
    let items = items.map(|items| items.iter().map(|one| (*one).to_owned()).collect());
    let digest = told(editing).unwrap().digest;
    Proposal { digest, state: state.to_owned(), changes: vec![Setting { key: key.to_owned(), items }] }
}

fn on_disk(editing: &Editing) -> String {
    std::fs::read_to_string(&editing.0.file).unwrap()
}

#[test]
fn states_are_told_with_what_they_say_and_what_is_in_force() {
    let folder = tempfile::tempdir().unwrap();
    let told = told(&editing(&folder)).unwrap();
    assert_eq!((told.states.len(), told.problem.as_str()), (2, ""));
    let key = |state: usize, key: &str| told.states[state].keys.iter().find(|one| one.key == key).unwrap().clone();
    assert_eq!(key(0, "duration").items, ["2"]);
    assert_eq!((key(0, "computes").said, key(0, "computes").listed), (false, false));
    assert_eq!(key(1, "effects").items, ["{ success: [hand_empty(gripper)], aborted: [] }"]);
    let force = |state: usize, key: &str| {
        let line = told.states[state].in_force.iter().find(|one| one.key == key).unwrap();
        (line.text.clone(), line.from.clone())
    };
    assert_eq!(force(0, "duration"), ("2".to_owned(), "this state".to_owned()));
    assert_eq!(force(0, "computes").1, "the catalogue, of path_planner/plan");
    assert_eq!(force(0, "requires").1, "default: nobody says otherwise");
    // This also holds for a state with `retry`.
    assert!(force(1, "resources").0.contains("Gripper"));
    assert!(told.predicates.iter().any(|one| one == "on(?, ?)"), "{:?}", told.predicates);
    // Without an ontology: the individuals that the file names, and those in the catalogue's annotations of its actions.
    assert_eq!(told.entities, ["base", "gripper"]);
}

/// The words offered at each place of a predicate of this task.
fn offered(task: &str, predicate: &str) -> Vec<Vec<String>> {
    let program = load(task, "t.yaml", &Catalogue::standard()).unwrap().program;
    let words = words(Some(&program));
    assert!(words.predicates.iter().any(|one| one == predicate), "{:?}", words.predicates);
    let places = words.places.iter().find(|one| one.predicate == predicate);
    places.unwrap_or_else(|| panic!("{:?}", words.places)).offered.clone()
}

#[test]
fn at_the_places_of_a_predicate_the_individuals_and_the_variables_that_the_file_has_there_are_offered() {
    let task = "\
task: t
parameters:
  arm: { type: string, default: left }
world: [\"on(cup, table)\"]
states:
  - for: box in [cup]
    do:
      - open:
          action: gripper/release
          reads: [in_gripper($box)]
          effects: [\"in_gripper($box, $arm) = pose(0, 0, 0)\", { for: \"b in [cup]\", do: [\"not on($b, table)\"] }]
";
    let [of_one, of_two] = ["in_gripper(?)", "in_gripper(?, ?)"].map(|predicate| offered(task, predicate));
    assert_eq!(of_one.len(), 1);
    assert_eq!(of_one[0][0], "$box");
    assert_eq!((of_two[0][0].as_str(), of_two[1][0].as_str()), ("$box", "$arm"));
    for place in of_one.iter().chain(&of_two) {
        let cups = place.iter().filter(|one| *one == "cup").count();
        assert!(cups == 1 && place.contains(&"table".to_owned()), "{place:?}");
    }
}

struct Example;

impl Files for Example {
    fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
        Ok((path.to_owned(), include_str!("../../../../examples/aimm.ttl").to_owned()))
    }
}

#[test]
fn an_ontology_says_which_individuals_fit_a_place() {
    let task = format!("{}\nontology: aimm.ttl\n", include_str!("../../../../examples/fetch_boxes.yaml"));
    let program = load_with(&task, "t.yaml", &Catalogue::standard(), &Example).unwrap().program;
    let words = words(Some(&program));
    let names = |place: &Vec<String>| -> BTreeSet<String> {
        place.iter().filter(|one| !one.starts_with('$')).cloned().collect()
    };
    let places = |predicate: &str| -> Vec<BTreeSet<String>> {
        words.places.iter().find(|one| one.predicate == predicate).unwrap().offered.iter().map(names).collect()
    };
    let set = |all: &[&str]| -> BTreeSet<String> { all.iter().map(|one| (*one).to_owned()).collect() };
    assert_eq!(places("hand_empty(?)"), [set(&["gripper"])]);
    let [what, where_to] = &places("on(?, ?)")[..] else { panic!("two places") };
    assert!(
        !what.contains("table") && where_to.contains("table") && where_to.contains("base"),
        "{what:?} {where_to:?}"
    );
    assert!(words.entities.len() > where_to.len());
}

#[test]
fn of_very_many_individuals_no_more_than_a_bound_is_told() {
    let facts: Vec<String> = (0..2_000).map(|one| format!("\"p{one}(i{one}, j)\"")).collect();
    let reads: Vec<String> = (0..400).map(|one| format!("p{one}($x, ?)")).collect();
    let task = format!(
        "task: t\nparameters: {{ x: {{ type: string, default: y }} }}\nworld: [{}]\nstates:\n  - open: {{ action: gripper/release, reads: {} }}\n",
        facts.join(", "),
        serde_json::to_string(&reads).unwrap(),
    );
    let words = words(Some(&load(&task, "t.yaml", &Catalogue::standard()).unwrap().program));
    assert_eq!((words.predicates.len(), words.entities.len()), (MAX_WORDS, MAX_WORDS));
    let placed: usize = words.places.iter().flat_map(|one| &one.offered).map(Vec::len).sum();
    assert!((1..=MAX_PLACED).contains(&placed) && words.places.len() < reads.len(), "{placed}");
}

#[test]
fn a_change_is_checked_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let editing = editing(&folder);
    let good = proposed(&editing, &proposal(&editing, "plan", "reads", Some(&["at(table)", "shape(table)"]))).unwrap();
    assert_eq!((good.problem.as_str(), good.refused, good.line), ("", false, 7));
    assert_eq!((good.before.len(), good.after), (0, vec!["      reads: [at(table), shape(table)]".to_owned()]));
    assert!(good.in_force.iter().any(|line| line.key == "reads" && line.from == "this state"));
    let bad = proposed(&editing, &proposal(&editing, "plan", "requires", Some(&["nothing.here = 1"]))).unwrap();
    assert!(bad.refused && bad.findings.iter().any(|one| one.path == "plan" && one.key == "requires"), "{bad:?}");
    let none = proposed(&editing, &proposal(&editing, "plan", "resources", Some(&["{ block: "]))).unwrap();
    assert!(none.problem.contains("is no value") && none.key == "resources", "{none:?}");
    assert_eq!(on_disk(&editing), TASK);
}

#[test]
fn a_change_is_written_and_all_else_and_the_mode_stay() {
    let folder = tempfile::tempdir().unwrap();
    let editing = editing(&folder);
    std::fs::set_permissions(&editing.0.file, std::fs::Permissions::from_mode(0o640)).unwrap();
    saved(&editing, &proposal(&editing, "plan", "duration", Some(&["3.5"]))).unwrap();
    assert_eq!(on_disk(&editing), TASK.replace("duration: 2", "duration: 3.5"));
    assert_eq!(std::fs::metadata(&editing.0.file).unwrap().permissions().mode() & 0o7777, 0o640);
    saved(&editing, &proposal(&editing, "open", "effects", None)).unwrap();
    assert!(on_disk(&editing).ends_with("retry: 1 }\n"));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is left beside it");
}

#[test]
fn extended_attributes_stay() {
    use rustix::fs::{XattrFlags, getxattr, setxattr};
    let folder = tempfile::tempdir().unwrap();
    let editing = editing(&folder);
    let file = &editing.0.file;
    if let Err(error) = setxattr(file, "user.note", b"kept", XattrFlags::empty()) {
        eprintln!("skipped: the file system of {} keeps no extended attributes: {error}", folder.path().display());
        return;
    }
    // User 12345 gets read access: version 2, then tag, permissions and id of each entry.
    let entries: [(u16, u16, u32); 5] =
        [(1, 6, u32::MAX), (2, 4, 12_345), (4, 4, u32::MAX), (0x10, 4, u32::MAX), (0x20, 0, u32::MAX)];
    let bytes = entries
        .iter()
        .flat_map(|(tag, may, id)| [&tag.to_le_bytes()[..], &may.to_le_bytes()[..], &id.to_le_bytes()[..]].concat());
    let list: Vec<u8> = 2_u32.to_le_bytes().into_iter().chain(bytes).collect();
    let with_list = setxattr(file, "system.posix_acl_access", &list, XattrFlags::empty()).is_ok();
    saved(&editing, &proposal(&editing, "plan", "duration", Some(&["3.5"]))).unwrap();
    assert!(on_disk(&editing).contains("duration: 3.5"));
    let value = |name: &str| {
        let mut value = vec![0; 1024];
        let length = getxattr(file, name, &mut value[..]).unwrap();
        value[..length].to_vec()
    };
    assert_eq!(value("user.note"), b"kept");
    if with_list {
        assert_eq!(value("system.posix_acl_access"), list);
        assert_eq!(std::fs::metadata(file).unwrap().permissions().mode() & 0o7777, 0o640);
    }
}

#[test]
fn what_else_a_state_may_say_of_itself_is_written_as_it_is_typed() {
    let folder = tempfile::tempdir().unwrap();
    let editing = editing(&folder);
    for (state, key, items, line) in [
        ("plan", "attempts", &["5"][..], "      attempts: 5\n"),
        ("plan", "deterministic", &["true"], "      deterministic: true\n"),
        ("plan", "exceptional", &["aborted"], "      exceptional: [aborted]\n"),
        ("plan", "exceptions", &["imprecise"], "      exceptions: imprecise\n"),
    ] {
        saved(&editing, &proposal(&editing, state, key, Some(items))).unwrap();
        assert!(on_disk(&editing).contains(line), "{key}: {}", on_disk(&editing));
    }
    saved(&editing, &proposal(&editing, "open", "pia", Some(&["true"]))).unwrap();
    assert!(on_disk(&editing).contains(", pia: true }"), "{}", on_disk(&editing));
    // Two of the three keys that form one annotation, and a value that is no boolean.
    for (key, items) in [("pia", &["true"][..]), ("deterministic", &["maybe"])] {
        let twice = proposal(&editing, "plan", "computes", Some(&["true"]));
        let both = Proposal {
            changes: [twice.changes, proposal(&editing, "plan", key, Some(items)).changes].concat(),
            ..twice
        };
        let told = proposed(&editing, &both).unwrap();
        assert!(told.refused && told.findings.iter().any(|one| one.path == "plan"), "{told:?}");
    }
}

#[test]
fn what_has_changed_on_the_disk_is_not_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    let editing = editing(&folder);
    let seen = proposal(&editing, "plan", "duration", Some(&["3"]));
    let other = format!("{TASK}# somebody else\n");
    std::fs::write(&editing.0.file, &other).unwrap();
    assert!(matches!(saved(&editing, &seen), Err(Problem::Changed { .. })));
    assert!(matches!(proposed(&editing, &seen), Err(Problem::Changed { .. })));
    // A change during the write is also detected.
    assert!(matches!(file::replace(&editing.0.file, TASK, "new", MAX_SOURCE), Err(FileError::Changed)));
    assert_eq!(on_disk(&editing), other);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn what_check_would_refuse_is_not_written_nor_a_file_that_is_read_only() {
    let folder = tempfile::tempdir().unwrap();
    let editing = editing(&folder);
    let bad = saved(&editing, &proposal(&editing, "plan", "duration", Some(&["nothing.here"])));
    assert!(matches!(bad, Err(Problem::Refused { .. })), "{bad:?}");
    std::fs::set_permissions(&editing.0.file, std::fs::Permissions::from_mode(0o444)).unwrap();
    let locked = saved(&editing, &proposal(&editing, "plan", "duration", Some(&["3"])));
    assert!(matches!(locked, Err(Problem::File(FileError::Write { .. }))), "{locked:?}");
    assert_eq!(on_disk(&editing), TASK);
}

#[test]
fn what_is_typed_is_read_as_it_was_shown() {
    for text in
        ["at(table)", "a.b = \"c, d\"", "{ block: Arm }", "3", "2.5", "true", "\"true\"", "\"{x: 1}\"", "[1, a]"]
    {
        let read = item(text).unwrap();
        assert_eq!(item(&typed(&read)), Ok(read.clone()), "{text}: {read:?}");
        assert_eq!(typed(&read), text);
    }
    assert!(item(" ").is_err() && item("{ a").is_err());
    for bomb in ["[&a [1, 1], *a, *a]", "{ a: &b 1 }", "&a 3", "*a"] {
        assert!(item(bomb).unwrap_err().contains("anchor or an alias"), "{bomb}");
    }
}

#[tokio::test]
async fn what_it_would_gain_is_said_or_why_it_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let editing = editing(&folder);
    let good = proposal(&editing, "plan", "duration", Some(&["3"]));
    let told = gained(&editing, good.clone()).await.unwrap();
    assert!(told.before_s.is_some() && told.before_s == told.after_s && told.obstacle.is_empty());
    let bad = gained(&editing, proposal(&editing, "plan", "duration", Some(&["no.where"]))).await.unwrap();
    assert!(bad.before_s.is_some() && bad.after_s.is_none() && bad.obstacle.contains("refuses"), "{bad:?}");
}

/// A simulation that never ends by itself, with the number of those that are running.
fn endless(folder: &tempfile::TempDir) -> (Editing, Arc<AtomicU64>) {
    let (file, going_on) = (folder.path().join("t.yaml"), Arc::new(AtomicU64::new(0)));
    std::fs::write(&file, TASK).unwrap();
    let own = Arc::clone(&going_on);
    let makespan = move |_: &Program, goes_on: &dyn Fn() -> bool| {
        own.fetch_add(1, Ordering::SeqCst);
        while goes_on() {
            std::thread::yield_now();
        }
        own.fetch_sub(1, Ordering::SeqCst);
        Err("ended".to_owned())
    };
    let check = |text: &str| load(text, "t.yaml", &Catalogue::standard());
    (Editing::of(file, Vec::new, check, makespan), going_on)
}

#[tokio::test]
async fn a_simulation_that_takes_too_long_is_really_ended() {
    let folder = tempfile::tempdir().unwrap();
    let (editing, going_on) = endless(&folder);
    let began = Instant::now();
    let told = gained(&editing, proposal(&editing, "plan", "duration", Some(&["3"]))).await.unwrap();
    assert_eq!(told.obstacle, "the simulation of the file with the change takes longer than 2 s");
    assert!(began.elapsed() >= 2 * SIMULATION);
    assert_eq!((going_on.load(Ordering::SeqCst), editing.0.simulating.available_permits()), (0, 1));
}

#[tokio::test]
async fn an_older_simulation_makes_room_for_the_newest() {
    let folder = tempfile::tempdir().unwrap();
    let (editing, going_on) = endless(&folder);
    let asked = |seconds: &str| {
        let proposal = proposal(&editing, "plan", "duration", Some(&[seconds]));
        let editing = editing.clone();
        tokio::spawn(async move { gained(&editing, proposal).await.unwrap() })
    };
    let older = asked("3");
    while going_on.load(Ordering::SeqCst) == 0 {
        tokio::task::yield_now().await;
    }
    let began = Instant::now();
    let newer = asked("4");
    assert_eq!(older.await.unwrap().obstacle, "something else was asked meanwhile");
    assert!(began.elapsed() < SIMULATION);
    assert!(newer.await.unwrap().obstacle.contains("takes longer"));
    assert_eq!(going_on.load(Ordering::SeqCst), 0);
}

#[tokio::test]
async fn a_simulation_for_which_nobody_waits_any_more_ends_its_thread() {
    let folder = tempfile::tempdir().unwrap();
    let (editing, going_on) = endless(&folder);
    let asked = tokio::spawn({
        let (editing, proposal) = (editing.clone(), proposal(&editing, "plan", "duration", Some(&["3"])));
        async move { gained(&editing, proposal).await.unwrap() }
    });
    while going_on.load(Ordering::SeqCst) == 0 {
        tokio::task::yield_now().await;
    }
    let began = Instant::now();
    asked.abort();
    // The thread releases its permit when it has ended.
    let place = editing.0.simulating.acquire().await.unwrap();
    assert!(began.elapsed() < SIMULATION / 2, "{:?}", began.elapsed());
    assert_eq!(going_on.load(Ordering::SeqCst), 0);
    drop(place);
}

#[test]
fn a_hash_that_is_typed_is_no_comment_and_tags_are_refused() {
    let text = |text: &str| Ok(Document::Text(text.to_owned()));
    assert_eq!((item("#"), item("2 # two"), item("\"!x\"")), (text("#"), text("2 # two"), text("!x")));
    assert_eq!((item("2"), item("~")), (Ok(Document::Int(2)), Ok(Document::Null)));
    for tagged in ["!!int 3", "!x", "[!!binary aGk=]", "{ a: !!float 1 }"] {
        assert!(item(tagged).unwrap_err().contains("a tag"), "{tagged}");
    }
}
