//! The JSON format of the answers to the pages: the one contract between this crate and `web/`.
//!
//! Each type is defined here once; `web/src/wire.ts` is generated from it ([`typescript`]), and a test reports if that file is outdated.
//! Times and durations are in seconds of robot time since the start of the run. Every text may come from a user and is shown as plain text,
//! never as markup.

use serde::Serialize;

/// A type that is part of the format.
trait Wire {
    /// The type in TypeScript.
    fn typescript() -> String;
}

macro_rules! named {
    ($name:literal: $($kind:ty),+) => {
        $(impl Wire for $kind {
            fn typescript() -> String {
                $name.to_owned()
            }
        })+
    };
}

named!("number": f64, u32, u64, usize, i64);
named!("string": String, &'static str);
named!("boolean": bool);

impl<T: Wire> Wire for Option<T> {
    fn typescript() -> String {
        format!("{} | null", T::typescript())
    }
}

impl<T: Wire> Wire for Vec<T> {
    fn typescript() -> String {
        format!("{}[]", T::typescript())
    }
}

/// Defines structs with their fields, in Rust and in TypeScript.
macro_rules! wire {
    ($($(#[doc = $doc:literal])+ $name:ident { $($(#[doc = $field_doc:literal])+ $field:ident: $kind:ty,)+ })+) => {
        $(
            $(#[doc = $doc])+
            #[derive(Debug, Clone, Default, PartialEq, Serialize)]
            pub(crate) struct $name {
                $($(#[doc = $field_doc])+ pub(crate) $field: $kind,)+
            }

            impl Wire for $name {
                fn typescript() -> String {
                    stringify!($name).to_owned()
                }
            }
        )+

        /// All types as a TypeScript module.
        pub fn typescript() -> String {
            let mut text = String::from("// Written from crates/dashboard/src/wire.rs; do not edit (RATN_WRITE_WIRE=1 and its test write it).\n");
            $(
                $(text.push_str(concat!("\n/**", $doc, " */"));)+
                text.push_str(concat!("\nexport interface ", stringify!($name), " {\n"));
                $(
                    $(text.push_str(concat!("  /**", $field_doc, " */\n"));)+
                    text.push_str(concat!("  ", stringify!($field), ": "));
                    text.push_str(&<$kind as Wire>::typescript());
                    text.push_str(";\n");
                )+
                text.push_str("}\n");
            )+
            text
        }
    };
}

wire! {
    /// What there is to be looked at.
    About {
        /// The version of the program.
        version: String,
        /// Whether the pages may tell a run something.
        control: bool,
        /// The task file whose annotations may be changed; empty without one.
        edit: String,
        /// The runtime directory of the system that is looked at; empty without one.
        directory: String,
        /// The logs, those of the command line first.
        logs: Vec<Log>,
        /// What is wrong with looking for runs; empty while all is well.
        problem: String,
    }

    /// An event log.
    Log {
        /// Its number here.
        id: u64,
        /// The name of its file.
        name: String,
        /// Where it is.
        path: String,
        /// A run writes it.
        live: bool,
    }

    /// A run, as far as it is looked at: what has changed since the version that was asked for.
    Frame {
        /// Which fold of the log it is. Of another one than before everything is told anew.
        epoch: u64,
        /// Up to which change it tells.
        version: u64,
        /// What was known before does not count any more.
        fresh: bool,
        /// There is more to be told: ask again at once.
        more: bool,
        /// The run as a whole.
        run: Run,
        /// Instances that are new or otherwise than before.
        instances: Vec<Instance>,
        /// Instances that are kept no more.
        gone: Vec<u64>,
        /// Why those wait that wait; as many as are said.
        waiting: Vec<Waiting>,
        /// Who holds what.
        held: Vec<Held>,
        /// Who has asked for what and has no answer, the next one first.
        queue: Vec<Queued>,
        /// Of each kind how many there are, as far as the log says.
        kinds: Vec<Kind>,
    }

    /// A run as a whole.
    Run {
        /// The task's name.
        task: String,
        /// Its id.
        id: String,
        /// The task file.
        file: String,
        /// `CDTN` or `HSM`.
        mode: String,
        /// What random choices are derived from.
        seed: String,
        /// When it began, in milliseconds since 1970; 0 where that is not said.
        began_unix_ms: u64,
        /// Its parameters as `name = value`.
        parameters: Vec<String>,
        /// How it ended; none while it goes on.
        outcome: Option<String>,
        /// Why it ended so; empty for a success.
        reason: String,
        /// Why the log cannot be read on; empty where it can.
        problem: String,
        /// From which moment on the log was read: 0 unless it is long.
        from_s: f64,
        /// The moment that is shown.
        at_s: f64,
        /// The last moment of the log.
        last_s: f64,
        /// A run writes the log.
        live: bool,
        /// The pages may tell it something.
        controllable: bool,
        /// States that wait for somebody, or for something that they look at themselves; only of a run that goes on.
        awaits: Vec<Awaits>,
        /// Whether the user has paused it, or a breakpoint has.
        paused: bool,
        /// The state at whose breakpoint it is paused, by path.
        stopped_at: Option<String>,
        /// Before which states it pauses, by their paths without visits.
        breakpoints: Vec<String>,
        /// From each request for a pause to its end.
        pauses: Vec<Span>,
        /// When task control was gone.
        absences: Vec<Span>,
        /// Instances so far.
        expanded: usize,
        /// Those that have become real.
        retired: usize,
        /// Those that were discarded.
        squashed: usize,
        /// Jobs ahead of time whose results are real.
        useful: usize,
        /// How long those took.
        useful_s: f64,
        /// Jobs ahead of time whose results were discarded.
        wasted: usize,
        /// How long those took.
        wasted_s: f64,
    }

    /// A state that waits by itself.
    Awaits {
        /// By path.
        path: String,
        /// `answer`, `signal`, or `other`: nobody has to do anything.
        kind: &'static str,
        /// The question, the name of the signal, or what it waits for.
        text: String,
        /// What may be answered.
        choices: Vec<String>,
        /// Until then at the most, in seconds.
        until_s: Option<f64>,
    }

    /// A time.
    Span {
        /// When it begins.
        from_s: f64,
        /// When it ends.
        to_s: f64,
    }

    /// One visit of a state.
    Instance {
        /// Its number in the log.
        id: u64,
        /// With visit numbers, `place_all[2]/plan_transfer`.
        path: String,
        /// Without: the state as its author wrote it.
        state: String,
        /// `waiting`, `asking`, `preparing`, `running`, `finished`, `retired` or `squashed`.
        stage: &'static str,
        /// Since when.
        since_s: f64,
        /// When it was expanded.
        expanded_s: f64,
        /// A condition on its path was undecided when it was expanded.
        speculative: bool,
        /// Its result was taken from an equal one.
        reused: bool,
        /// Its outcome.
        outcome: Option<String>,
        /// What it decided, where it decides.
        decision: Option<String>,
        /// The stages it has left, the last ones.
        phases: Vec<Phase>,
        /// What was done for it, by attempts.
        jobs: Vec<Job>,
        /// When it waited for resources.
        waits: Vec<Wait>,
        /// On whom it depended.
        edges: Vec<Edge>,
        /// Why its result did not count; once for each time.
        invalidations: Vec<String>,
    }

    /// A stage that is over.
    Phase {
        /// Which.
        stage: &'static str,
        /// When it began.
        from_s: f64,
        /// When it ended.
        to_s: f64,
        /// What ended it, as it stands behind "waited for".
        awaited: String,
    }

    /// From giving a provider a goal to its end.
    Job {
        /// The provider and what it did.
        action: String,
        /// `motion`, `detection`, `planning` or `other`.
        activity: &'static str,
        /// From 1.
        attempt: u32,
        /// When it began.
        from_s: f64,
        /// When it ended; none while it goes on.
        to_s: Option<f64>,
        /// Its outcome, `crashed` or `cancelled`; empty while it goes on.
        ending: String,
        /// Why, where it is not success.
        reason: String,
        /// `used`, `lost` or `open`.
        worth: &'static str,
        /// Ids of the resources that it held.
        resources: Vec<String>,
    }

    /// From asking for resources to their grant.
    Wait {
        /// When it asked.
        from_s: f64,
        /// When it had them.
        to_s: f64,
        /// What it asked for.
        kinds: Vec<String>,
        /// Who held something of these kinds meanwhile, the one that held longest first.
        behind: Vec<String>,
    }

    /// A dependency of one instance on another.
    Edge {
        /// The other.
        from: u64,
        /// `data`, `world`, `resource` or `condition`.
        kind: &'static str,
    }

    /// An instance that does not run, and why.
    Waiting {
        /// Which.
        id: u64,
        /// In one sentence.
        sentence: String,
        /// Since when.
        since_s: f64,
    }

    /// A resource in the hands of an instance.
    Held {
        /// The resource.
        resource: String,
        /// Its kind.
        kind: String,
        /// Who has it, by path.
        holder: String,
        /// Which instance that is.
        instance: u64,
        /// Since when.
        from_s: f64,
    }

    /// An instance that has asked for resources.
    Queued {
        /// Which.
        instance: u64,
        /// By path.
        path: String,
        /// The kinds that it asked for.
        kinds: Vec<String>,
        /// Larger goes first.
        priority: i64,
        /// Since when.
        from_s: f64,
    }

    /// A kind of resources.
    Kind {
        /// Its name.
        kind: String,
        /// How many there are.
        total: usize,
        /// How many the run holds.
        held: usize,
    }

    /// A task as its author wrote it.
    Task {
        /// The task file is what it was when the run began, and reads.
        known: bool,
        /// Why not; empty where it is.
        note: String,
        /// The states that do or decide something, in the order of the file.
        states: Vec<State>,
        /// What goes from one to another.
        flows: Vec<Flow>,
        /// Where a breakpoint pauses a run: states that may change the environment, and what they are inside of; in the order of the file.
        stops: Vec<String>,
    }

    /// A state.
    State {
        /// Its path.
        path: String,
        /// `action` or `condition`.
        kind: &'static str,
    }

    /// A dependency of one state on another, as written.
    Flow {
        /// Whose result it is.
        from: String,
        /// Whose input, or existence, depends on that.
        to: String,
        /// `data` or `condition`.
        kind: &'static str,
    }

    /// The world of a run, as far as its log tells it.
    World {
        /// The moment.
        at_s: f64,
        /// The root's revision.
        revision: u64,
        /// The facts of the root, in their order; as many as are shown.
        facts: Vec<Fact>,
        /// How many fit the filter.
        fitting: usize,
        /// How many there are.
        all: usize,
        /// What was written last, the latest first.
        history: Vec<Written>,
        /// The projections that are being worked on.
        projections: Vec<Projection>,
        /// From which moment on the log was read: what is older is not known.
        from_s: f64,
    }

    /// A fact of the root.
    Fact {
        /// Its key.
        key: String,
        /// Its value.
        value: String,
        /// Who wrote it, by path.
        writer: String,
        /// When.
        at_s: f64,
        /// In which revision.
        revision: u64,
    }

    /// A change that became real.
    Written {
        /// When.
        at_s: f64,
        /// In which revision.
        revision: u64,
        /// Who, by path.
        writer: String,
        /// Which fact.
        key: String,
        /// Its value before; none where it had none.
        before: Option<String>,
        /// Its value since; none where it is gone.
        after: Option<String>,
    }

    /// A projected world, against the root.
    Projection {
        /// For which instance.
        instance: u64,
        /// By path.
        path: String,
        /// The root's revision below it.
        base: u64,
        /// What is otherwise in it.
        changes: Vec<Projected>,
    }

    /// What is otherwise in a projection.
    Projected {
        /// Which fact, or which facts.
        key: String,
        /// Its value in the root; none where it has none.
        root: Option<String>,
        /// What becomes of it.
        change: String,
        /// Who is going to write it, by path.
        writer: String,
    }

    /// The system that is up.
    System {
        /// It is: the resource manager answers.
        up: bool,
        /// What is wrong; empty while all is well.
        problem: String,
        /// Resources, room for projections left out.
        resources: Vec<Resource>,
        /// Acquires that wait.
        waiting: Vec<Acquire>,
        /// Sessions that hold or provide something.
        sessions: Vec<Session>,
        /// Hosts with their pools.
        hosts: Vec<Host>,
    }

    /// A resource of the system.
    Resource {
        /// Its id.
        id: String,
        /// Its kind.
        kind: String,
        /// Its host.
        host: String,
        /// What it is doing.
        state: String,
        /// How much of it can be had, and how much there is.
        free: String,
        /// Who has some of it.
        holdings: Vec<Holding>,
    }

    /// A part of a resource that somebody has.
    Holding {
        /// Who.
        holder: String,
        /// The session of the lease.
        session: String,
        /// The lease.
        lease: u64,
        /// Its fencing token.
        token: u64,
        /// In how many milliseconds the session of the lease ends unless it is pinged; none where that is not known.
        expires_in_ms: Option<u64>,
    }

    /// An acquire that waits.
    Acquire {
        /// Who asks.
        holder: String,
        /// Larger first.
        priority: i64,
        /// How many are served before it.
        ahead: u32,
        /// What is in the way.
        obstacles: Vec<String>,
    }

    /// A session with the resource manager.
    Session {
        /// Its id.
        id: String,
        /// Who that is.
        client: String,
        /// In how many milliseconds it ends unless it is pinged.
        expires_in_ms: u64,
        /// How many leases it has.
        leases: usize,
        /// How many resources it provides.
        resources: usize,
    }

    /// A host.
    Host {
        /// Its name.
        name: String,
        /// Why it does not answer; empty where it does.
        problem: String,
        /// It takes no new work.
        draining: bool,
        /// Its pools.
        pools: Vec<Pool>,
    }

    /// The workers of a template.
    Pool {
        /// The template.
        template: String,
        /// The kind of resource that they are.
        kind: String,
        /// At least so many are kept.
        min: u32,
        /// At most so many are started.
        max: u32,
        /// So many more than are held are kept ready.
        spares: u32,
        /// Workers that ended without being asked to.
        crashes: u64,
        /// How the last of those ended.
        last_exit: String,
        /// Why no more are started; empty while all is well.
        failure: String,
        /// The oldest first.
        workers: Vec<Worker>,
    }

    /// A worker process.
    Worker {
        /// Its id.
        id: String,
        /// What it is doing.
        state: String,
        /// Its process.
        pid: u32,
        /// Resident memory in bytes.
        resident_bytes: u64,
        /// Processor use, in thousandths of a core.
        cpu_millicores: u32,
        /// How long it has been there.
        age_s: u64,
        /// Whether somebody holds its resource.
        held: bool,
        /// What it may use of the machine; empty without limits.
        limits: String,
    }

    /// The end of what a worker has written.
    Tail {
        /// The worker.
        worker: String,
        /// The text.
        text: String,
        /// There is more before it.
        cut: bool,
    }

    /// A robot as a tree of links, to be drawn.
    Robot {
        /// It is known.
        known: bool,
        /// Its name.
        name: String,
        /// Whence it is known, or why it is not.
        note: String,
        /// What of its visuals is not drawn, and why, in a sentence each.
        lacks: Vec<String>,
        /// Parents before children; the first one is where the world's origin is.
        links: Vec<Link>,
        /// The joints that have a position of their own; the links say which of them moves what.
        joints: Vec<Joint>,
        /// The tool of each arm, by its link; the first one carries what is held.
        tools: Vec<usize>,
    }

    /// A rigid link.
    Link {
        /// Its name.
        name: String,
        /// The link on which it hangs.
        parent: Option<usize>,
        /// Where its joint sits in the parent's frame.
        at: Place,
        /// The joint that moves it; one that mimics another is moved by that.
        joint: Option<usize>,
        /// Along or about which that moves it: x, y, z.
        axis: Vec<f64>,
        /// Along, not about.
        slides: bool,
        /// How far it moves for one radian or metre of the joint.
        factor: f64,
        /// What of it can collide.
        shapes: Vec<Shape>,
        /// What of it is seen. A robot on which nothing is seen is drawn as what of it can collide.
        visuals: Vec<Visual>,
    }

    /// A shape that is seen.
    Visual {
        /// Its form.
        shape: Shape,
        /// Of a mesh the number by which its corners are asked for.
        mesh: Option<usize>,
        /// Red, green and blue from 0 to 1; none where the robot's description says none.
        colour: Option<Vec<f64>>,
    }

    /// A joint.
    Joint {
        /// Its name.
        name: String,
        /// Its position is in metres, not in radians.
        slides: bool,
        /// Where it is taken to be before the log says something.
        start: f64,
    }

    /// A position and a rotation.
    Place {
        /// x, y, z in metres.
        position: Vec<f64>,
        /// A unit quaternion: x, y, z, w.
        quaternion: Vec<f64>,
    }

    /// A primitive, its axis along z, or a mesh in its bounding box.
    Shape {
        /// `box`, `cylinder`, `capsule`, `sphere`, or of a visual also `mesh`.
        kind: &'static str,
        /// Of a box and of the box around a mesh the edges along x, y, z; else the radius and the length along z, of a capsule that of its straight part.
        size: Vec<f64>,
        /// Where its centre is.
        at: Place,
    }

    /// The robot and the objects at a moment of a log, as the run believes them.
    Cell {
        /// Which fold of the log it is.
        epoch: u64,
        /// Up to which change it tells.
        version: u64,
        /// What was known before does not count any more.
        fresh: bool,
        /// The log is not read up to the moment yet: ask again.
        more: bool,
        /// The moment.
        at_s: f64,
        /// The log was read from this moment on: what was moved between its start and then is not known.
        from_s: f64,
        /// The log's joints are those of the robot: it is shown.
        fits: bool,
        /// Why the robot is not shown, or what is not known of it; empty where there is nothing to say.
        note: String,
        /// Where joints go, what is new or otherwise than before; a later one counts.
        tracks: Vec<Track>,
        /// The ids of all tracks that are still of interest, in their order.
        kept: Vec<u64>,
        /// Where the base of the robot is believed to stand.
        base: Place,
        /// The objects as they are believed to be; none where they are as before.
        objects: Option<Vec<Object>>,
        /// How many more there are than are told.
        untold: usize,
        /// The objects as they are, where the cell of a run that is under way tells it.
        truth: Option<Truth>,
    }

    /// Where some joints are, or go.
    Track {
        /// Its number.
        id: u64,
        /// The joints, by their indices.
        joints: Vec<usize>,
        /// When it begins.
        from_s: f64,
        /// When it was over, wherever the joints were then; none while it goes on.
        until_s: Option<f64>,
        /// The times of its points are what is expected, not what was commanded.
        estimated: bool,
        /// Which state that is, by path; empty where none moves.
        path: String,
        /// In order. Where the first one is not at 0 it begins where the joints are.
        points: Vec<Point>,
    }

    /// A point of a track.
    Point {
        /// Seconds from the start of the track.
        after_s: f64,
        /// A position for each joint.
        positions: Vec<f64>,
        /// A speed for each joint; empty where that is not said.
        velocities: Vec<f64>,
    }

    /// An object.
    Object {
        /// Its name.
        name: String,
        /// Its form, and where it is: in the world, or, where it is held, seen from the tool.
        shape: Shape,
        /// The gripper holds it.
        held: bool,
    }

    /// Objects as they are.
    Truth {
        /// Where they are, all in the world.
        objects: Vec<Object>,
        /// Why the cell does not tell; empty where it does.
        problem: String,
    }

    /// A task file with what its states say of themselves, and what is in force for them.
    Annotations {
        /// Where it is.
        file: String,
        /// Of its text: what is changed is this text, and no other one.
        digest: String,
        /// Why there are no states to be shown; empty where there are.
        problem: String,
        /// Its states, in its order.
        states: Vec<AnnotatedState>,
        /// The kinds of resources of the catalogue.
        kinds: Vec<String>,
        /// The predicates of the ontology, and those that the file uses, with as many arguments as they have: `at(?)`.
        predicates: Vec<String>,
        /// The individuals of the ontology, and those that the file uses.
        entities: Vec<String>,
        /// What is offered for the places of predicates where that is not all individuals.
        places: Vec<Places>,
        /// What is wrong with it.
        findings: Vec<Finding>,
    }

    /// What is offered for the places of a predicate: individuals of the class that the ontology says, and variables that the file has there.
    Places {
        /// As among the predicates: `in_gripper(?, ?)`.
        predicate: String,
        /// Of each place.
        offered: Vec<Vec<String>>,
    }

    /// A state of a task file.
    AnnotatedState {
        /// Its path.
        path: String,
        /// How many states are around it.
        depth: usize,
        /// What it is: `action: gripper/grasp`.
        form: String,
        /// The line of the file.
        line: u32,
        /// Why it cannot be changed here; empty where it can.
        fixed: String,
        /// The annotations that it may have.
        keys: Vec<AnnotationKey>,
        /// What is in force for it; nothing of a state that performs no action.
        in_force: Vec<InForceLine>,
    }

    /// What a state says under a key.
    AnnotationKey {
        /// The key.
        key: String,
        /// The state says something under it.
        said: bool,
        /// What it says, an item each, as the file has it.
        items: Vec<String>,
        /// There may be several items.
        listed: bool,
    }

    /// What is in force under a key.
    InForceLine {
        /// The key.
        key: String,
        /// As a task file says it, or `everything`, `nothing`, `unknown`.
        text: String,
        /// Who says so: the state, its action, or nobody.
        from: String,
    }

    /// What is wrong with a task file.
    Finding {
        /// `error` or `warning`.
        severity: String,
        /// The name of the rule.
        rule: String,
        /// The state; empty for the task.
        path: String,
        /// The key of the state; empty where it is of none.
        key: String,
        /// The line of the file with the change in it.
        line: u32,
        /// What is wrong.
        message: String,
        /// What to do.
        help: String,
    }

    /// What a change would lead to; nothing is written.
    Proposed {
        /// Why the text cannot be changed so; empty where it can.
        problem: String,
        /// The key that the problem is of; empty where it is of none.
        key: String,
        /// The task would be refused.
        refused: bool,
        /// What would be wrong with the file.
        findings: Vec<Finding>,
        /// What would be in force for the state.
        in_force: Vec<InForceLine>,
        /// The lines of the file that would be others, as they are.
        before: Vec<String>,
        /// These lines as they would be.
        after: Vec<String>,
        /// The number of the first of them.
        line: u32,
    }

    /// What a change would gain, by simulation as a dataflow network.
    Gained {
        /// The makespan of the file as it is.
        before_s: Option<f64>,
        /// The makespan with the change.
        after_s: Option<f64>,
        /// Why there is none; empty where there is.
        obstacle: String,
    }

    /// What became of what a run was told.
    Told {
        /// In a sentence.
        said: String,
    }

    /// Why something was not answered.
    Refusal {
        /// In a sentence.
        problem: String,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]

    /// `RATN_WRITE_WIRE=1` writes the file.
    #[test]
    fn the_types_of_the_pages_are_those_of_this_crate() {
        let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("web/src/wire.ts");
        let here = super::typescript();
        if std::env::var_os("RATN_WRITE_WIRE").is_some() {
            std::fs::write(&file, &here).unwrap();
        }
        let there = std::fs::read_to_string(&file).unwrap();
        assert!(here == there, "{} is not what wire.rs gives: RATN_WRITE_WIRE=1 writes it anew", file.display());
    }

    #[test]
    fn fields_are_named_and_typed_as_serde_writes_them() {
        let edge = serde_json::to_value(super::Edge { from: 7, kind: "data" }).unwrap();
        assert_eq!(edge, serde_json::json!({ "from": 7, "kind": "data" }));
        let text = super::typescript();
        assert!(text.contains("export interface Edge {"), "{text}");
        assert!(text.contains("  outcome: string | null;") && text.contains("  edges: Edge[];"), "{text}");
    }
}
