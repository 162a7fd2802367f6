//! Ontologies: what they allow, what they refuse, and that hostile ones are refused soon.

#![allow(clippy::unwrap_used, reason = "a test may panic")]
#![allow(clippy::disallowed_methods, reason = "that reading is bounded in time is what is tested")]

use ratn_model::catalogue::Catalogue;
use ratn_model::fact::{Change, FactKey, FactPattern, Term};
use ratn_model::load::{Files, MAX_SOURCE, load_with};
use ratn_model::measurement::{Certainty, Measurement};
use ratn_model::ontology::turtle::imports::{MAX_FILES, read_with};
use ratn_model::ontology::turtle::{MAX_CLASSES, MAX_STATEMENTS, OntologyError, read};
use ratn_model::ontology::{Ontology, Uncertainty};
use ratn_model::pose::Pose;
use ratn_model::program::Nature;
use ratn_model::tolerance::{Deviation, Tolerance, Tolerances};
use ratn_model::value::Value;
use std::time::{Duration, Instant};

const PREFIXES: &str = "@prefix ratn: <urn:ratn:ontology#> . @prefix rdfs: <http://www.w3.org/2000/01/rdf-schema#> .
@prefix owl: <http://www.w3.org/2002/07/owl#> . @prefix xsd: <http://www.w3.org/2001/XMLSchema#> . @prefix : <urn:test#> .\n";

/// Longer than reading anything within the bounds takes, by far, in a debug build on a busy machine.
const SOON: Duration = Duration::from_secs(60);

fn ontology(text: &str) -> Ontology {
    read(&format!("{PREFIXES}{text}")).unwrap()
}

fn refusal(text: &str) -> String {
    let began = Instant::now();
    let refused = read(&format!("{PREFIXES}{text}")).unwrap_err().to_string();
    assert!(began.elapsed() < SOON, "{:?}: {refused}", began.elapsed());
    refused
}

fn kitchen() -> Ontology {
    ontology(
        ":Thing a owl:Class . :Object a owl:Class ; rdfs:subClassOf :Thing . :Box a rdfs:Class ; rdfs:subClassOf :Object ; ratn:named \"box_\" .
         :Mood a owl:Class . :calm a :Mood . :table a :Object ; rdfs:label \"a table\" .
         :on a ratn:Predicate ; ratn:arguments ( :Box :Thing ) ; ratn:value \"bool\" .
         :count a ratn:Predicate ; ratn:arguments ( owl:Thing xsd:integer ) ; ratn:value \"int\" .
         :mood a ratn:Predicate ; ratn:arguments () ; ratn:value :Mood .",
    )
}

fn key(predicate: &str, arguments: &[&str]) -> FactKey {
    let term = |text: &&str| text.parse().map_or_else(|_| Term::Name((*text).to_owned()), Term::Int);
    FactKey { predicate: predicate.to_owned(), arguments: arguments.iter().map(term).collect() }
}

fn set(predicate: &str, arguments: &[&str], value: Value) -> Change {
    Change::Set { fact: key(predicate, arguments), value }
}

#[test]
fn what_fits_is_allowed_over_subclasses_names_and_open_arguments() {
    let kitchen = kitchen();
    let text = |text: &str| Value::String(text.to_owned());
    let any = FactPattern { predicate: "on".to_owned(), arguments: vec![None, Some(Term::Name("table".to_owned()))] };
    let changes = [
        set("on", &["box_1", "table"], Value::Bool(true)),
        set("on", &["box_1", "box_2"], Value::Null),
        set("count", &["whoever", "3"], Value::Int(1)),
        set("mood", &[], text("calm")),
        Change::Delete { pattern: any },
        Change::Increase { fact: key("count", &["x", "0"]), by: 2.0 },
    ];
    assert_eq!(kitchen.check_changes(&changes), Ok(()));
    assert!(kitchen.is_a("box_7", "Thing") && !kitchen.is_a("table", "Box") && !kitchen.is_a("calm", "Thing"));
}

#[test]
fn what_does_not_fit_is_refused_with_the_rule() {
    let kitchen = kitchen();
    let yes = || Value::Bool(true);
    for (change, said) in [
        (
            set("onn", &["box_1", "table"], yes()),
            "[unknown-predicate] the ontology has no predicate `onn`; did you mean `on`?",
        ),
        (set("on", &["box_1"], yes()), "[outside-domain] `on` has 2 arguments, and `on(box_1)` has 1"),
        (
            set("on", &["table", "box_1"], yes()),
            "[outside-domain] in `on(table, box_1)`, `table` is a Object, not a Box",
        ),
        (
            set("on", &["box_1", "tabel"], yes()),
            "[outside-domain] in `on(box_1, tabel)`, `tabel` is no individual of the ontology; a Thing is expected; did you mean `table`?",
        ),
        (set("on", &["1", "table"], yes()), "[outside-domain] in `on(1, table)`, `1` is not a Box"),
        (set("count", &["x", "y"], Value::Int(1)), "[outside-domain] in `count(x, y)`, `y` is not a whole number"),
        (set("on", &["box_1", "table"], Value::Int(1)), "[outside-range] `on(box_1, table)` is bool, and 1 is int"),
        (
            set("mood", &[], Value::String("table".to_owned())),
            "[outside-range] as the value of `mood()`, `table` is a Object, not a Mood",
        ),
        (set("mood", &[], Value::Int(1)), "[outside-range] `mood()` is the name of a Mood, and 1 is int"),
        (
            Change::Increase { fact: key("count", &["x", "0"]), by: 0.5 },
            "[outside-range] `count(x, 0)` is int, and 0.5 is float",
        ),
        (
            Change::Delete { pattern: FactPattern { predicate: "on".to_owned(), arguments: vec![None] } },
            "[outside-domain] `on` has 2 arguments, and `on(?)` has 1",
        ),
    ] {
        assert_eq!(kitchen.check_change(&change).unwrap_err().to_string(), said);
    }
}

#[test]
fn what_an_ontology_says_and_nobody_would_check_is_refused() {
    for (text, said) in [
        (":a a :B .", "`a`: `<urn:test#B>` is not declared as a class, `a owl:Class`"),
        (":B a owl:Class . :a rdfs:label \"a\" .", "`a`: nothing says what it is; write `a :Class`"),
        (":B a owl:Class ; :color \"red\" .", "`B`: `urn:test#color` is not understood here; leave it out"),
        (":p a ratn:Predicate ; ratn:value \"int\" .", "`p`: a predicate says its `ratn:arguments ( … )`"),
        (":p a ratn:Predicate ; ratn:arguments () ; ratn:value \"int\", \"bool\" .", "`p`: `ratn:value` is said twice"),
        (
            ":B a owl:Class . <urn:other#B> a owl:Class .",
            "`B`: `urn:other#B` and `urn:test#B` would have one name in tasks",
        ),
        (":B a owl:Class ; ratn:named \"\" .", "`B`: `ratn:named` is how names begin, not empty"),
    ] {
        assert_eq!(refusal(text), said);
    }
    assert!(refusal(":p a ratn:Predicate ; ratn:arguments () ; ratn:value \"number\" .").contains("is not a type"));
    assert!(refusal("\n:p a").starts_with("line "));
}

#[test]
fn circles_are_refused_wherever_they_are() {
    let circle = "`A`: it is a subclass of itself, directly or over others; break the circle";
    assert_eq!(refusal(":A a owl:Class ; rdfs:subClassOf :A ."), circle);
    let three = ":A a owl:Class ; rdfs:subClassOf :B . :B a owl:Class ; rdfs:subClassOf :C . :C a owl:Class ; rdfs:subClassOf :A .";
    assert_eq!(refusal(three), circle);
    let list = "@prefix rdf: <http://www.w3.org/1999/02/22-rdf-syntax-ns#> . :C a owl:Class .
        :p a ratn:Predicate ; ratn:value \"int\" ; ratn:arguments _:l . _:l rdf:first :C ; rdf:rest _:l .";
    assert!(refusal(list).contains("`ratn:arguments` is a list of classes"));
}

#[test]
fn hostile_turtle_is_refused_soon() {
    assert!(refusal(&" ".repeat(MAX_SOURCE)).contains("bytes"));
    let many: String = (0..=MAX_STATEMENTS).map(|i| format!(":a :b {i} .\n")).collect();
    assert!(refusal(&many).contains("statements"));
    let classes: String = (0..=MAX_CLASSES).map(|i| format!(":c{i} a owl:Class .\n")).collect();
    assert!(refusal(&classes).contains("classes"));
    for (open, close) in [("[ :p ", "]"), ("( ", ")"), ("<< ", ">>"), ("[", ""), ("(", ""), ("\"\"\"", "")] {
        let depth = (MAX_SOURCE - 1_000) / (open.len() + close.len());
        refusal(&format!(":a :b {}1{} .", open.repeat(depth), close.repeat(depth)));
    }
}

#[test]
fn the_deepest_and_the_widest_hierarchy_within_the_bounds_are_read_soon() {
    let began = Instant::now();
    let above = |i: usize| if i == 0 { String::new() } else { format!(" ; rdfs:subClassOf :c{}", i - 1) };
    let deep: String = (0..MAX_CLASSES).map(|i| format!(":c{i} a owl:Class{} .\n", above(i))).collect();
    let deep = ontology(&format!("{deep}:x a :c{} .", MAX_CLASSES - 1));
    assert!(deep.is_a("x", "c0"));
    // Every one below all before it, as far as the statements last.
    let wide: String = (0..190)
        .map(|i| {
            let all: String = (0..i).map(|j| format!(" ; rdfs:subClassOf :c{j}")).collect();
            format!(":c{i} a owl:Class{all} .\n")
        })
        .collect();
    ontology(&wide);
    assert!(began.elapsed() < SOON, "{:?}", began.elapsed());
}

struct Example;

impl Files for Example {
    fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
        Ok((path.to_owned(), include_str!("../../../examples/aimm.ttl").to_owned()))
    }
}

#[test]
fn the_examples_say_only_what_their_ontology_allows() {
    for task in [include_str!("../../../examples/fetch_boxes.yaml"), include_str!("../../../examples/set_table.yaml")] {
        let plain = load_with(task, "task.yaml", &Catalogue::standard(), &Example).unwrap().program;
        let described = format!("{task}\nontology: aimm.ttl\n");
        let loaded = load_with(&described, "task.yaml", &Catalogue::standard(), &Example).unwrap();
        assert!(plain.ontology.is_none());
        assert_eq!(loaded.program.ontology, Some(read(include_str!("../../../examples/aimm.ttl")).unwrap()));
        assert_ne!(plain.digest, loaded.program.digest);
    }
}

#[test]
fn two_regions_change_facts_of_one_subject_of_a_functional_predicate_only_if_all_of_these_are_shared() {
    let is_refused = |first: &str, second: &str, shared: &str| {
        let task = format!(
            "task: t\nontology: aimm.ttl\nstates:\n  - both:\n      concurrency: barrier\n      regions:\n        - left: {{ action: gripper/release, pia: true, reads: [], effects: ['{first}'], shared: [{shared}], resources: [{{ block: Gripper }}] }}\n        - right: {{ action: pan_tilt/look_at, in: {{ target: \"pose(1, 0, 0)\" }}, pia: true, reads: [], effects: ['{second}'], resources: [{{ block: PanTilt }}] }}\n"
        );
        match load_with(&task, "task.yaml", &Catalogue::standard(), &Example) {
            Ok(_) => false,
            Err(found) => {
                assert!(found.iter().all(|finding| finding.rule == "region-conflict"), "{found:#?}");
                true
            }
        }
    };
    for (first, second, shared, expected) in [
        ("on(box_1, table)", "not on(box_1, place_1)", "", true),
        ("not on(box_1, place_1)", "on(box_1, table)", "", true),
        ("on(box_1, table)", "on(box_1, place_1)", "", true),
        ("on(box_1, table)", "not on(box_1, place_1)", "'on(box_1, table)'", true),
        ("on(box_1, table)", "not on(box_1, place_1)", "'on(box_1, ?)'", false),
        ("not on(box_1, table)", "not on(box_1, place_1)", "", false),
        ("on(box_1, table)", "not on(box_2, place_1)", "", false),
    ] {
        assert_eq!(is_refused(first, second, shared), expected, "{first} beside {second}, shared: {shared}");
    }
}

#[test]
fn what_a_predicate_says_beside_its_value_is_read_and_counts() {
    let shop = ontology(
        ":Box a owl:Class ; ratn:named \"box_\" .
         :on a ratn:Predicate , owl:FunctionalProperty ; ratn:arguments ( :Box :Box ) ; ratn:value \"bool\" .
         :at a ratn:Predicate ; ratn:arguments ( :Box ) ; ratn:value \"pose\" ; ratn:geometric true ; ratn:ttl 30 ;
             ratn:positionTolerance 0.02 ; ratn:angleTolerance 0.1 ; ratn:uncertainty \"covariance\" .
         :weight a ratn:Predicate ; ratn:arguments ( :Box ) ; ratn:value \"float\" ; ratn:unit \"kg\" ; ratn:tolerance 0.05 .",
    );
    let at = shop.predicate("at").unwrap();
    assert_eq!((at.ttl_s, at.uncertainty, at.functional), (Some(30.0), Some(Uncertainty::Covariance), false));
    assert_eq!(shop.scene(), [("at", 1)]);
    assert_eq!(shop.rivals(&key("on", &["box_1", "box_2"])).unwrap().to_string(), "on(box_1, ?)");
    assert_eq!(shop.rivals(&key("at", &["box_1"])), None);
    assert_eq!(
        shop.check_change(&set("weight", &["box_1"], Value::Bool(true))).unwrap_err().to_string(),
        "[outside-range] `weight(box_1)` is float in kg, and true is bool"
    );
    let of_task = Deviation { number: Some(0.5), position_m: Some(0.5), ..Deviation::default() };
    let of_weight = Deviation { number: Some(1.0), ..Deviation::default() };
    let tolerances =
        Tolerances { default: of_task, predicates: [("weight".to_owned(), of_weight)].into_iter().collect() };
    let tolerances = shop.tolerances(tolerances);
    let of = |predicate: &str| tolerances.of(predicate, Tolerance::EXACT);
    assert_eq!(of("at"), Tolerance { position_m: 0.02, angle_rad: 0.1, number: 0.5 });
    assert_eq!(of("weight"), Tolerance { position_m: 0.5, angle_rad: 0.0, number: 1.0 });
}

#[test]
fn what_a_predicate_says_of_what_its_value_does_not_hold_is_refused() {
    for (value, more, said) in [
        ("bool", "ratn:tolerance 1", "`ratn:tolerance` is said, and its value holds no number"),
        ("float", "ratn:positionTolerance 1", "`ratn:positionTolerance` is said, and its value holds no pose"),
        ("float", "ratn:angleTolerance 1", "`ratn:angleTolerance` is said, and its value holds no pose"),
        ("string", "ratn:unit \"m\"", "`ratn:unit` is said, and its value holds no number"),
        (
            "bool",
            "ratn:uncertainty \"covariance\"",
            "`ratn:uncertainty` is said, and its value holds no number or pose to have a covariance",
        ),
        ("bool", "ratn:uncertainty \"some\"", "`ratn:uncertainty` is \"confidence\" or \"covariance\", found `some`"),
        ("float", "ratn:tolerance -1", "`ratn:tolerance` is a number from 0, found `-1`"),
        ("float", "ratn:tolerance 1, 2", "`ratn:tolerance` is said twice"),
        ("float", "ratn:ttl 0", "`ratn:ttl` is above 0: a fact that is stale at once says nothing"),
        ("float", "ratn:ttl \"NaN\"", "`ratn:ttl` is a number from 0, found `NaN`"),
        ("float", "ratn:unit \"\"", "`ratn:unit` is a short name, found ``"),
        ("float", "ratn:geometric \"perhaps\"", "`ratn:geometric` is true or false, found `perhaps`"),
        ("float", "a owl:FunctionalProperty", "a functional predicate has a subject, and this one has no arguments"),
        ("float", "ratn:tolerances 1", "`urn:ratn:ontology#tolerances` is not understood here; leave it out"),
    ] {
        let text = format!(":p a ratn:Predicate ; ratn:arguments () ; ratn:value \"{value}\" ; {more} .");
        assert_eq!(refusal(&text), format!("`p`: {said}"));
    }
}

/// One predicate that makes the scene, one that does not.
struct Shop(&'static str);

impl Files for Shop {
    fn read(&self, _: &str, path: &str) -> Result<(String, String), String> {
        let text = ":Box a owl:Class ; ratn:named \"box_\" . :weight a ratn:Predicate ; ratn:arguments ( :Box ) ; ratn:value \"float\" .
            :place a ratn:Predicate ; ratn:arguments ( :Box ) ; ratn:value \"pose\" ; ratn:positionTolerance 0.02 ; ratn:geometric ";
        Ok((path.to_owned(), format!("{PREFIXES}{text}{} .", self.0)))
    }
}

#[test]
fn the_scene_and_the_tolerances_of_a_task_are_those_of_its_ontology() {
    let task = "task: t\nontology: shop.ttl\ntolerance: { number: 0.1, predicates: { weight: 2 } }\nstates:
  - plan: { action: path_planner/plan, in: { start: \"joints(0, 0, 0, 0, 0, 0, 0)\", goal: \"joints(0, 0, 0, 0, 0, 0, 0)\" }, computes: true, reads: [scene],
            resources: [{ block: PathPlanner }] }\n";
    let program = load_with(task, "task.yaml", &Catalogue::standard(), &Shop("true")).unwrap().program;
    let reads = program.states[1].annotations.reads.as_ref().unwrap();
    assert_eq!(reads.iter().map(ToString::to_string).collect::<Vec<_>>(), ["place(?)"]);
    let of = |predicate: &str| program.tolerances.of(predicate, Tolerance::ROBOT);
    assert_eq!(of("weight"), Tolerance { number: 2.0, ..Tolerance::ROBOT });
    assert_eq!(of("place"), Tolerance { number: 0.1, position_m: 0.02, ..Tolerance::ROBOT });
    let refused = load_with(task, "task.yaml", &Catalogue::standard(), &Shop("false")).unwrap_err();
    assert_eq!((refused.len(), refused[0].rule.as_str()), (1, "unknown-predicate"), "{}", refused[0]);
}

#[test]
fn of_what_actions_say_a_task_with_an_ontology_of_its_own_keeps_what_that_has_predicates_for() {
    let task = "task: t\nontology: shop.ttl\nstates:
  - move: { action: arm/move_to, in: { joints: \"joints(0, 0, 0, 0, 0, 0, 0)\" }, effects: [\"place(box_1) = pose(0, 0, 0)\"] }
  - plan: { action: path_planner/plan, in: { start: \"joints(0, 0, 0, 0, 0, 0, 0)\", goal: \"joints(0, 0, 0, 0, 0, 0, 0)\" } }
  - close: { action: gripper/grasp, in: { object: box_1, expected: \"place(box_1)\" } }
  - look: { action: detector/locate, in: { object: \"{id: box_1, pose: place(box_1), size: [1.0]}\" } }\n";
    for (geometric, scene) in [("true", "place(?)"), ("false", "")] {
        let loaded = load_with(task, "task.yaml", &Catalogue::standard(), &Shop(geometric));
        let program = loaded.unwrap_or_else(|findings| panic!("{findings:#?}")).program;
        let told = |n: usize| {
            let said = &program.states[n].annotations;
            let reads: Vec<String> = said.reads.iter().flatten().map(ToString::to_string).collect();
            let effects =
                said.effects.get("success").map(|effects| effects.iter().map(ToString::to_string).collect::<Vec<_>>());
            (reads.join(", "), said.requires.len(), effects)
        };
        assert_eq!(told(1), (String::new(), 0, Some(vec!["set place(box_1) = pose(0, 0, 0)".to_owned()])));
        assert_eq!(told(2), (scene.to_owned(), 0, Some(vec![])));
        assert_eq!(told(3), (String::new(), 0, Some(vec![])), "no hand_empty(gripper), no in_gripper(box_1)");
        assert_eq!(program.states[4].annotations.nature, Nature::Irreversible, "what a look depends on has no name");
    }
}

struct Folder(&'static [(&'static str, &'static str)]);

impl Folder {
    fn read(&self, first: &str) -> Result<Ontology, String> {
        let file = |_: &str, path: &str| {
            let found = self.0.iter().find(|(name, _)| *name == path).ok_or("there is no such file")?;
            Ok((path.to_owned(), format!("{PREFIXES}{}", found.1)))
        };
        let (name, text) = file("", first)?;
        let error = |error: OntologyError| {
            let sources = std::iter::successors(Some(&error as &dyn std::error::Error), |error| error.source());
            sources.map(ToString::to_string).collect::<Vec<_>>().join(": ")
        };
        read_with(&name, &text, &file).map(|(ontology, _)| ontology).map_err(error)
    }
}

#[test]
fn an_ontology_of_several_files_is_one() {
    let folder = Folder(&[
        ("task.ttl", "<> a owl:Ontology ; owl:imports <robot.ttl> , \"../things.ttl\" . :cup a :Object ."),
        (
            "robot.ttl",
            "_:a a owl:Ontology ; owl:imports \"../things.ttl\" . :Arm a owl:Class . :arm a :Arm .
            :held a ratn:Predicate ; ratn:arguments ( :Arm ) ; ratn:value :Object .",
        ),
        (
            "../things.ttl",
            "_:a a owl:Ontology . :Object a owl:Class . :at a ratn:Predicate ; ratn:arguments ( :Object ) ; ratn:value \"pose\" .",
        ),
    ]);
    let ontology = folder.read("task.ttl").unwrap();
    ontology.check_change(&set("held", &["arm"], Value::String("cup".to_owned()))).unwrap();
    ontology.check_change(&set("at", &["cup"], Value::Null)).unwrap();
    assert!(ontology.check_change(&set("at", &["arm"], Value::Null)).is_err());
}

#[test]
fn what_cannot_be_imported_is_refused_with_where() {
    let refusal = |files| Folder(files).read("a.ttl").unwrap_err();
    let circle = refusal(&[
        ("a.ttl", "[] a owl:Ontology ; owl:imports <b.ttl> ."),
        ("b.ttl", "[] a owl:Ontology ; owl:imports <c.ttl> ."),
        ("c.ttl", "[] a owl:Ontology ; owl:imports <b.ttl> ."),
    ]);
    assert!(circle.contains("`a.ttl` imports `b.ttl` imports `c.ttl` imports `b.ttl`"), "{circle}");
    let missing = refusal(&[("a.ttl", "[] a owl:Ontology ; owl:imports <b.ttl> .")]);
    assert!(missing.contains("`b.ttl`: it is imported and cannot be read: there is no such file"), "{missing}");
    let far = refusal(&[("a.ttl", "[] a owl:Ontology ; owl:imports <http://example.org/b> .")]);
    assert!(far.contains("names a file beside this one"), "{far}");
    let within = refusal(&[("a.ttl", "[] a owl:Ontology ; owl:imports <b.ttl> ."), ("b.ttl", ":x :y .")]);
    assert!(within.starts_with("b.ttl: line "), "{within}");
}

#[test]
fn files_that_import_each_other_without_end_are_refused_soon() {
    let began = Instant::now();
    let chain = |_: &str, path: &str| {
        let number: usize = path.parse().map_err(|_| "no number".to_owned())?;
        Ok((path.to_owned(), format!("{PREFIXES}[] a owl:Ontology ; owl:imports \"{}\" .", number + 1)))
    };
    let first = format!("{PREFIXES}[] a owl:Ontology ; owl:imports \"1\" .");
    let refused = read_with("0", &first, &chain).unwrap_err();
    assert!(format!("{refused:?}").contains("at most 8 deep"), "{refused:?}");
    let wide: String = (0..MAX_FILES).map(|i| format!("[] a owl:Ontology ; owl:imports \"{i}\" .")).collect();
    let leaf = |_: &str, path: &str| Ok((path.to_owned(), String::new()));
    let refused = read_with("first", &format!("{PREFIXES}{wide}"), &leaf).unwrap_err();
    assert!(format!("{refused:?}").contains("files"), "{refused:?}");
    assert!(began.elapsed() < SOON);
}

#[test]
fn a_measurement_is_as_sure_as_its_predicate_declares() {
    let ontology = ontology(
        ":Thing a owl:Class ; ratn:named \"box\" .
         :at a ratn:Predicate ; ratn:arguments ( :Thing ) ; ratn:value \"pose\" ; ratn:uncertainty \"covariance\" .
         :full a ratn:Predicate ; ratn:arguments ( :Thing ) ; ratn:value \"bool\" ; ratn:uncertainty \"confidence\" .
         :on a ratn:Predicate ; ratn:arguments ( :Thing ) ; ratn:value \"bool\" .",
    );
    let check = |predicate: &str, value: Value, certainty: Option<Certainty>| {
        let measured = Measurement { source: "camera".to_owned(), certainty };
        ontology
            .check_measurement(&key(predicate, &["box_1"]), &value, &measured)
            .map_err(|refused| refused.to_string())
    };
    let (pose, covariance) = (Value::Pose(Pose::IDENTITY), |n: usize| Some(Certainty::Covariance(vec![0.1; n])));
    check("at", pose.clone(), covariance(36)).unwrap();
    check("at", pose.clone(), None).unwrap();
    check("full", Value::Bool(true), Some(Certainty::Confidence(0.5))).unwrap();
    for (refused, why) in [
        (check("at", pose.clone(), covariance(9)), "has 6 times 6 entries, and 9 were measured"),
        (
            check("at", pose, Some(Certainty::Confidence(0.5))),
            "is measured with a covariance, and this has a confidence",
        ),
        (check("on", Value::Bool(true), Some(Certainty::Confidence(0.5))), "declares no uncertainty"),
    ] {
        let refused = refused.unwrap_err();
        assert!(refused.starts_with("[other-uncertainty]") && refused.contains(why), "{refused}");
    }
}
