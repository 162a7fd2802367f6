// Written from crates/dashboard/src/wire.rs; do not edit (RATN_WRITE_WIRE=1 and its test write it).

/** What there is to be looked at. */
export interface About {
  /** The version of the program. */
  version: string;
  /** Whether the pages may tell a run something. */
  control: boolean;
  /** The task file whose annotations may be changed; empty without one. */
  edit: string;
  /** The runtime directory of the system that is looked at; empty without one. */
  directory: string;
  /** The logs, those of the command line first. */
  logs: Log[];
  /** What is wrong with looking for runs; empty while all is well. */
  problem: string;
}

/** An event log. */
export interface Log {
  /** Its number here. */
  id: number;
  /** The name of its file. */
  name: string;
  /** Where it is. */
  path: string;
  /** A run writes it. */
  live: boolean;
}

/** A run, as far as it is looked at: what has changed since the version that was asked for. */
export interface Frame {
  /** Which fold of the log it is. Of another one than before everything is told anew. */
  epoch: number;
  /** Up to which change it tells. */
  version: number;
  /** What was known before does not count any more. */
  fresh: boolean;
  /** There is more to be told: ask again at once. */
  more: boolean;
  /** The run as a whole. */
  run: Run;
  /** Instances that are new or otherwise than before. */
  instances: Instance[];
  /** Instances that are kept no more. */
  gone: number[];
  /** Why those wait that wait; as many as are said. */
  waiting: Waiting[];
  /** Who holds what. */
  held: Held[];
  /** Who has asked for what and has no answer, the next one first. */
  queue: Queued[];
  /** Of each kind how many there are, as far as the log says. */
  kinds: Kind[];
}

/** A run as a whole. */
export interface Run {
  /** The task's name. */
  task: string;
  /** Its id. */
  id: string;
  /** The task file. */
  file: string;
  /** `CDTN` or `HSM`. */
  mode: string;
  /** What random choices are derived from. */
  seed: string;
  /** When it began, in milliseconds since 1970; 0 where that is not said. */
  began_unix_ms: number;
  /** Its parameters as `name = value`. */
  parameters: string[];
  /** How it ended; none while it goes on. */
  outcome: string | null;
  /** Why it ended so; empty for a success. */
  reason: string;
  /** Why the log cannot be read on; empty where it can. */
  problem: string;
  /** From which moment on the log was read: 0 unless it is long. */
  from_s: number;
  /** The moment that is shown. */
  at_s: number;
  /** The last moment of the log. */
  last_s: number;
  /** A run writes the log. */
  live: boolean;
  /** The pages may tell it something. */
  controllable: boolean;
  /** States that wait for somebody, or for something that they look at themselves; only of a run that goes on. */
  awaits: Awaits[];
  /** Whether the user has paused it, or a breakpoint has. */
  paused: boolean;
  /** The state at whose breakpoint it is paused, by path. */
  stopped_at: string | null;
  /** Before which states it pauses, by their paths without visits. */
  breakpoints: string[];
  /** From each request for a pause to its end. */
  pauses: Span[];
  /** When task control was gone. */
  absences: Span[];
  /** Instances so far. */
  expanded: number;
  /** Those that have become real. */
  retired: number;
  /** Those that were discarded. */
  squashed: number;
  /** Jobs ahead of time whose results are real. */
  useful: number;
  /** How long those took. */
  useful_s: number;
  /** Jobs ahead of time whose results were discarded. */
  wasted: number;
  /** How long those took. */
  wasted_s: number;
}

/** A state that waits by itself. */
export interface Awaits {
  /** By path. */
  path: string;
  /** `answer`, `signal`, or `other`: nobody has to do anything. */
  kind: string;
  /** The question, the name of the signal, or what it waits for. */
  text: string;
  /** What may be answered. */
  choices: string[];
  /** Until then at the most, in seconds. */
  until_s: number | null;
}

/** A time. */
export interface Span {
  /** When it begins. */
  from_s: number;
  /** When it ends. */
  to_s: number;
}

/** One visit of a state. */
export interface Instance {
  /** Its number in the log. */
  id: number;
  /** With visit numbers, `place_all[2]/plan_transfer`. */
  path: string;
  /** Without: the state as its author wrote it. */
  state: string;
  /** `waiting`, `asking`, `preparing`, `running`, `finished`, `retired` or `squashed`. */
  stage: string;
  /** Since when. */
  since_s: number;
  /** When it was expanded. */
  expanded_s: number;
  /** A condition on its path was undecided when it was expanded. */
  speculative: boolean;
  /** Its result was taken from an equal one. */
  reused: boolean;
  /** Its outcome. */
  outcome: string | null;
  /** What it decided, where it decides. */
  decision: string | null;
  /** The stages it has left, the last ones. */
  phases: Phase[];
  /** What was done for it, by attempts. */
  jobs: Job[];
  /** When it waited for resources. */
  waits: Wait[];
  /** On whom it depended. */
  edges: Edge[];
  /** Why its result did not count; once for each time. */
  invalidations: string[];
}

/** A stage that is over. */
export interface Phase {
  /** Which. */
  stage: string;
  /** When it began. */
  from_s: number;
  /** When it ended. */
  to_s: number;
  /** What ended it, as it stands behind "waited for". */
  awaited: string;
}

/** From giving a provider a goal to its end. */
export interface Job {
  /** The provider and what it did. */
  action: string;
  /** `motion`, `detection`, `planning` or `other`. */
  activity: string;
  /** From 1. */
  attempt: number;
  /** When it began. */
  from_s: number;
  /** When it ended; none while it goes on. */
  to_s: number | null;
  /** Its outcome, `crashed` or `cancelled`; empty while it goes on. */
  ending: string;
  /** Why, where it is not success. */
  reason: string;
  /** `used`, `lost` or `open`. */
  worth: string;
  /** Ids of the resources that it held. */
  resources: string[];
}

/** From asking for resources to their grant. */
export interface Wait {
  /** When it asked. */
  from_s: number;
  /** When it had them. */
  to_s: number;
  /** What it asked for. */
  kinds: string[];
  /** Who held something of these kinds meanwhile, the one that held longest first. */
  behind: string[];
}

/** A dependency of one instance on another. */
export interface Edge {
  /** The other. */
  from: number;
  /** `data`, `world`, `resource` or `condition`. */
  kind: string;
}

/** An instance that does not run, and why. */
export interface Waiting {
  /** Which. */
  id: number;
  /** In one sentence. */
  sentence: string;
  /** Since when. */
  since_s: number;
}

/** A resource in the hands of an instance. */
export interface Held {
  /** The resource. */
  resource: string;
  /** Its kind. */
  kind: string;
  /** Who has it, by path. */
  holder: string;
  /** Which instance that is. */
  instance: number;
  /** Since when. */
  from_s: number;
}

/** An instance that has asked for resources. */
export interface Queued {
  /** Which. */
  instance: number;
  /** By path. */
  path: string;
  /** The kinds that it asked for. */
  kinds: string[];
  /** Larger goes first. */
  priority: number;
  /** Since when. */
  from_s: number;
}

/** A kind of resources. */
export interface Kind {
  /** Its name. */
  kind: string;
  /** How many there are. */
  total: number;
  /** How many the run holds. */
  held: number;
}

/** A task as its author wrote it. */
export interface Task {
  /** The task file is what it was when the run began, and reads. */
  known: boolean;
  /** Why not; empty where it is. */
  note: string;
  /** The states that do or decide something, in the order of the file. */
  states: State[];
  /** What goes from one to another. */
  flows: Flow[];
  /** Where a breakpoint pauses a run: states that may change the environment, and what they are inside of; in the order of the file. */
  stops: string[];
}

/** A state. */
export interface State {
  /** Its path. */
  path: string;
  /** `action` or `condition`. */
  kind: string;
}

/** A dependency of one state on another, as written. */
export interface Flow {
  /** Whose result it is. */
  from: string;
  /** Whose input, or existence, depends on that. */
  to: string;
  /** `data` or `condition`. */
  kind: string;
}

/** The world of a run, as far as its log tells it. */
export interface World {
  /** The moment. */
  at_s: number;
  /** The root's revision. */
  revision: number;
  /** The facts of the root, in their order; as many as are shown. */
  facts: Fact[];
  /** How many fit the filter. */
  fitting: number;
  /** How many there are. */
  all: number;
  /** What was written last, the latest first. */
  history: Written[];
  /** The projections that are being worked on. */
  projections: Projection[];
  /** From which moment on the log was read: what is older is not known. */
  from_s: number;
}

/** A fact of the root. */
export interface Fact {
  /** Its key. */
  key: string;
  /** Its value. */
  value: string;
  /** Who wrote it, by path. */
  writer: string;
  /** When. */
  at_s: number;
  /** In which revision. */
  revision: number;
}

/** A change that became real. */
export interface Written {
  /** When. */
  at_s: number;
  /** In which revision. */
  revision: number;
  /** Who, by path. */
  writer: string;
  /** Which fact. */
  key: string;
  /** Its value before; none where it had none. */
  before: string | null;
  /** Its value since; none where it is gone. */
  after: string | null;
}

/** A projected world, against the root. */
export interface Projection {
  /** For which instance. */
  instance: number;
  /** By path. */
  path: string;
  /** The root's revision below it. */
  base: number;
  /** What is otherwise in it. */
  changes: Projected[];
}

/** What is otherwise in a projection. */
export interface Projected {
  /** Which fact, or which facts. */
  key: string;
  /** Its value in the root; none where it has none. */
  root: string | null;
  /** What becomes of it. */
  change: string;
  /** Who is going to write it, by path. */
  writer: string;
}

/** The system that is up. */
export interface System {
  /** It is: the resource manager answers. */
  up: boolean;
  /** What is wrong; empty while all is well. */
  problem: string;
  /** Resources, room for projections left out. */
  resources: Resource[];
  /** Acquires that wait. */
  waiting: Acquire[];
  /** Sessions that hold or provide something. */
  sessions: Session[];
  /** Hosts with their pools. */
  hosts: Host[];
}

/** A resource of the system. */
export interface Resource {
  /** Its id. */
  id: string;
  /** Its kind. */
  kind: string;
  /** Its host. */
  host: string;
  /** What it is doing. */
  state: string;
  /** How much of it can be had, and how much there is. */
  free: string;
  /** Who has some of it. */
  holdings: Holding[];
}

/** A part of a resource that somebody has. */
export interface Holding {
  /** Who. */
  holder: string;
  /** The session of the lease. */
  session: string;
  /** The lease. */
  lease: number;
  /** Its fencing token. */
  token: number;
  /** In how many milliseconds the session of the lease ends unless it is pinged; none where that is not known. */
  expires_in_ms: number | null;
}

/** An acquire that waits. */
export interface Acquire {
  /** Who asks. */
  holder: string;
  /** Larger first. */
  priority: number;
  /** How many are served before it. */
  ahead: number;
  /** What is in the way. */
  obstacles: string[];
}

/** A session with the resource manager. */
export interface Session {
  /** Its id. */
  id: string;
  /** Who that is. */
  client: string;
  /** In how many milliseconds it ends unless it is pinged. */
  expires_in_ms: number;
  /** How many leases it has. */
  leases: number;
  /** How many resources it provides. */
  resources: number;
}

/** A host. */
export interface Host {
  /** Its name. */
  name: string;
  /** Why it does not answer; empty where it does. */
  problem: string;
  /** It takes no new work. */
  draining: boolean;
  /** Its pools. */
  pools: Pool[];
}

/** The workers of a template. */
export interface Pool {
  /** The template. */
  template: string;
  /** The kind of resource that they are. */
  kind: string;
  /** At least so many are kept. */
  min: number;
  /** At most so many are started. */
  max: number;
  /** So many more than are held are kept ready. */
  spares: number;
  /** Workers that ended without being asked to. */
  crashes: number;
  /** How the last of those ended. */
  last_exit: string;
  /** Why no more are started; empty while all is well. */
  failure: string;
  /** The oldest first. */
  workers: Worker[];
}

/** A worker process. */
export interface Worker {
  /** Its id. */
  id: string;
  /** What it is doing. */
  state: string;
  /** Its process. */
  pid: number;
  /** Resident memory in bytes. */
  resident_bytes: number;
  /** Processor use, in thousandths of a core. */
  cpu_millicores: number;
  /** How long it has been there. */
  age_s: number;
  /** Whether somebody holds its resource. */
  held: boolean;
  /** What it may use of the machine; empty without limits. */
  limits: string;
}

/** The end of what a worker has written. */
export interface Tail {
  /** The worker. */
  worker: string;
  /** The text. */
  text: string;
  /** There is more before it. */
  cut: boolean;
}

/** A robot as a tree of links, to be drawn. */
export interface Robot {
  /** It is known. */
  known: boolean;
  /** Its name. */
  name: string;
  /** Whence it is known, or why it is not. */
  note: string;
  /** What of its visuals is not drawn, and why, in a sentence each. */
  lacks: string[];
  /** Parents before children; the first one is where the world's origin is. */
  links: Link[];
  /** The joints that have a position of their own; the links say which of them moves what. */
  joints: Joint[];
  /** The tool of each arm, by its link; the first one carries what is held. */
  tools: number[];
}

/** A rigid link. */
export interface Link {
  /** Its name. */
  name: string;
  /** The link on which it hangs. */
  parent: number | null;
  /** Where its joint sits in the parent's frame. */
  at: Place;
  /** The joint that moves it; one that mimics another is moved by that. */
  joint: number | null;
  /** Along or about which that moves it: x, y, z. */
  axis: number[];
  /** Along, not about. */
  slides: boolean;
  /** How far it moves for one radian or metre of the joint. */
  factor: number;
  /** What of it can collide. */
  shapes: Shape[];
  /** What of it is seen. A robot on which nothing is seen is drawn as what of it can collide. */
  visuals: Visual[];
}

/** A shape that is seen. */
export interface Visual {
  /** Its form. */
  shape: Shape;
  /** Of a mesh the number by which its corners are asked for. */
  mesh: number | null;
  /** Red, green and blue from 0 to 1; none where the robot's description says none. */
  colour: number[] | null;
}

/** A joint. */
export interface Joint {
  /** Its name. */
  name: string;
  /** Its position is in metres, not in radians. */
  slides: boolean;
  /** Where it is taken to be before the log says something. */
  start: number;
}

/** A position and a rotation. */
export interface Place {
  /** x, y, z in metres. */
  position: number[];
  /** A unit quaternion: x, y, z, w. */
  quaternion: number[];
}

/** A primitive, its axis along z, or a mesh in its bounding box. */
export interface Shape {
  /** `box`, `cylinder`, `capsule`, `sphere`, or of a visual also `mesh`. */
  kind: string;
  /** Of a box and of the box around a mesh the edges along x, y, z; else the radius and the length along z, of a capsule that of its straight part. */
  size: number[];
  /** Where its centre is. */
  at: Place;
}

/** The robot and the objects at a moment of a log, as the run believes them. */
export interface Cell {
  /** Which fold of the log it is. */
  epoch: number;
  /** Up to which change it tells. */
  version: number;
  /** What was known before does not count any more. */
  fresh: boolean;
  /** The log is not read up to the moment yet: ask again. */
  more: boolean;
  /** The moment. */
  at_s: number;
  /** The log was read from this moment on: what was moved between its start and then is not known. */
  from_s: number;
  /** The log's joints are those of the robot: it is shown. */
  fits: boolean;
  /** Why the robot is not shown, or what is not known of it; empty where there is nothing to say. */
  note: string;
  /** Where joints go, what is new or otherwise than before; a later one counts. */
  tracks: Track[];
  /** The ids of all tracks that are still of interest, in their order. */
  kept: number[];
  /** Where the base of the robot is believed to stand. */
  base: Place;
  /** The objects as they are believed to be; none where they are as before. */
  objects: Object[] | null;
  /** How many more there are than are told. */
  untold: number;
  /** The objects as they are, where the cell of a run that is under way tells it. */
  truth: Truth | null;
}

/** Where some joints are, or go. */
export interface Track {
  /** Its number. */
  id: number;
  /** The joints, by their indices. */
  joints: number[];
  /** When it begins. */
  from_s: number;
  /** When it was over, wherever the joints were then; none while it goes on. */
  until_s: number | null;
  /** The times of its points are what is expected, not what was commanded. */
  estimated: boolean;
  /** Which state that is, by path; empty where none moves. */
  path: string;
  /** In order. Where the first one is not at 0 it begins where the joints are. */
  points: Point[];
}

/** A point of a track. */
export interface Point {
  /** Seconds from the start of the track. */
  after_s: number;
  /** A position for each joint. */
  positions: number[];
  /** A speed for each joint; empty where that is not said. */
  velocities: number[];
}

/** An object. */
export interface Object {
  /** Its name. */
  name: string;
  /** Its form, and where it is: in the world, or, where it is held, seen from the tool. */
  shape: Shape;
  /** The gripper holds it. */
  held: boolean;
}

/** Objects as they are. */
export interface Truth {
  /** Where they are, all in the world. */
  objects: Object[];
  /** Why the cell does not tell; empty where it does. */
  problem: string;
}

/** A task file with what its states say of themselves, and what is in force for them. */
export interface Annotations {
  /** Where it is. */
  file: string;
  /** Of its text: what is changed is this text, and no other one. */
  digest: string;
  /** Why there are no states to be shown; empty where there are. */
  problem: string;
  /** Its states, in its order. */
  states: AnnotatedState[];
  /** The kinds of resources of the catalogue. */
  kinds: string[];
  /** The predicates of the ontology, and those that the file uses, with as many arguments as they have: `at(?)`. */
  predicates: string[];
  /** The individuals of the ontology, and those that the file uses. */
  entities: string[];
  /** What is offered for the places of predicates where that is not all individuals. */
  places: Places[];
  /** What is wrong with it. */
  findings: Finding[];
}

/** What is offered for the places of a predicate: individuals of the class that the ontology says, and variables that the file has there. */
export interface Places {
  /** As among the predicates: `in_gripper(?, ?)`. */
  predicate: string;
  /** Of each place. */
  offered: string[][];
}

/** A state of a task file. */
export interface AnnotatedState {
  /** Its path. */
  path: string;
  /** How many states are around it. */
  depth: number;
  /** What it is: `action: gripper/grasp`. */
  form: string;
  /** The line of the file. */
  line: number;
  /** Why it cannot be changed here; empty where it can. */
  fixed: string;
  /** The annotations that it may have. */
  keys: AnnotationKey[];
  /** What is in force for it; nothing of a state that performs no action. */
  in_force: InForceLine[];
}

/** What a state says under a key. */
export interface AnnotationKey {
  /** The key. */
  key: string;
  /** The state says something under it. */
  said: boolean;
  /** What it says, an item each, as the file has it. */
  items: string[];
  /** There may be several items. */
  listed: boolean;
}

/** What is in force under a key. */
export interface InForceLine {
  /** The key. */
  key: string;
  /** As a task file says it, or `everything`, `nothing`, `unknown`. */
  text: string;
  /** Who says so: the state, its action, or nobody. */
  from: string;
}

/** What is wrong with a task file. */
export interface Finding {
  /** `error` or `warning`. */
  severity: string;
  /** The name of the rule. */
  rule: string;
  /** The state; empty for the task. */
  path: string;
  /** The key of the state; empty where it is of none. */
  key: string;
  /** The line of the file with the change in it. */
  line: number;
  /** What is wrong. */
  message: string;
  /** What to do. */
  help: string;
}

/** What a change would lead to; nothing is written. */
export interface Proposed {
  /** Why the text cannot be changed so; empty where it can. */
  problem: string;
  /** The key that the problem is of; empty where it is of none. */
  key: string;
  /** The task would be refused. */
  refused: boolean;
  /** What would be wrong with the file. */
  findings: Finding[];
  /** What would be in force for the state. */
  in_force: InForceLine[];
  /** The lines of the file that would be others, as they are. */
  before: string[];
  /** These lines as they would be. */
  after: string[];
  /** The number of the first of them. */
  line: number;
}

/** What a change would gain, by simulation as a dataflow network. */
export interface Gained {
  /** The makespan of the file as it is. */
  before_s: number | null;
  /** The makespan with the change. */
  after_s: number | null;
  /** Why there is none; empty where there is. */
  obstacle: string;
}

/** What became of what a run was told. */
export interface Told {
  /** In a sentence. */
  said: string;
}

/** Why something was not answered. */
export interface Refusal {
  /** In a sentence. */
  problem: string;
}
