//! The features of random programs. A failure is examined with as few of them as still show it.

/// The features of random programs, in addition to sequences, hierarchies, loops over lists, conditions, routines and all three kinds of
/// actions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Features {
    /// Custom outcomes, handlers of failures, jumps forward and back.
    pub transitions: bool,
    /// `while` and `do … while`.
    pub whiles: bool,
    /// Concurrencies whose regions do not conflict.
    pub regions: bool,
    /// Concurrencies in which the first region that ends preempts the others.
    pub preemptive: bool,
    /// Scoped variables, assignments, defaults of ports.
    pub variables: bool,
    /// Retries after failures, and timeouts of goals that never answer.
    pub retries: bool,
    /// Numeric preconditions, quantified effects, effects per custom outcome.
    pub effects: bool,
    /// Measured facts that differ from the predictions.
    pub measured: bool,
    /// Results that do not depend on the seed; small widths; exceptional outcomes.
    pub speculation: bool,
    /// Facts with zero, two and three arguments, individuals, wildcards, queries, records and their fields.
    pub facts: bool,
    /// Keys that come from ports, nested quantified effects, lists that may be empty.
    pub keys: bool,
    /// Numeric effects of any amount, and effects that depend on the fact itself.
    pub amounts: bool,
    /// A predicate that is measured within a tolerance, and ontologies.
    pub tolerance: bool,
    /// Hierarchies that see nothing of their surroundings, and parameters.
    pub libraries: bool,
    /// Resources that are selected by attributes, divisible, scarce, or not renewable.
    pub supplies: bool,
    /// Durations, learned durations and learned outcomes; attempts that are used up.
    pub estimates: bool,
    /// Shapes in which bugs were found and that chance does not make: see `generator/patterns`.
    pub patterns: bool,
    /// Emergency stops, refused resources, runs that are resumed.
    pub incidents: bool,
    /// Loops of a thousand, chains of a hundred.
    pub long: bool,
    /// No state reads the world, so that behaviour never depends on it.
    pub blind: bool,
    /// What the safety theorem excludes: imprecise exceptions, unordered resources, shared facts.
    pub weak: bool,
    /// Parts of expressions are replaced by equivalent comprehensions.
    pub lists: bool,
    /// `retry` with `before`, and `finally`.
    pub guards: bool,
    /// States that wait: for a time, a condition, a signal, an answer.
    pub waits: bool,
    /// Motions and hierarchies with `while` conditions.
    pub watched: bool,
    /// Queries are replaced by equivalent uses of `find`.
    pub finds: bool,
    /// Anytime actions.
    pub anytime: bool,
    /// Timeouts of composites, and races whose regions share nothing; `finally` of states inside of these and of regions; effects for
    /// the outcome `preempted`.
    pub ways_out: bool,
    /// Outputs of conditions, loops and concurrencies, with values that depend on the way taken.
    pub outputs: bool,
}

impl Features {
    /// The first set of features, under the assumptions of the safety theorem. The programs of its seeds never change.
    pub const ALL: Features = Features {
        transitions: true,
        whiles: true,
        regions: true,
        preemptive: true,
        variables: true,
        retries: true,
        effects: true,
        measured: true,
        speculation: true,
        facts: false,
        keys: false,
        amounts: false,
        tolerance: false,
        libraries: false,
        supplies: false,
        estimates: false,
        patterns: false,
        incidents: false,
        long: false,
        blind: false,
        weak: false,
        lists: false,
        guards: false,
        waits: false,
        watched: false,
        finds: false,
        anytime: false,
        ways_out: false,
        outputs: false,
    };

    /// Sequences, hierarchies, loops over lists, conditions, routines and actions alone.
    pub const BASIC: Features = Features {
        transitions: false,
        whiles: false,
        regions: false,
        preemptive: false,
        variables: false,
        retries: false,
        effects: false,
        measured: false,
        speculation: false,
        facts: false,
        keys: false,
        amounts: false,
        tolerance: false,
        libraries: false,
        supplies: false,
        estimates: false,
        patterns: false,
        incidents: false,
        long: false,
        blind: false,
        weak: false,
        lists: false,
        guards: false,
        waits: false,
        watched: false,
        finds: false,
        anytime: false,
        ways_out: false,
        outputs: false,
    };

    /// [`Features::ALL`], without these assumptions.
    pub const WEAK: Features = Features { weak: true, ..Features::ALL };

    /// The whole model, under the assumptions of the safety theorem.
    pub const EVERYTHING: Features = Features {
        facts: true,
        keys: true,
        amounts: true,
        tolerance: true,
        libraries: true,
        supplies: true,
        estimates: true,
        patterns: true,
        incidents: true,
        long: true,
        ..Features::ALL
    };

    /// [`Features::EVERYTHING`], rewritten with comprehensions.
    pub const LISTS: Features = Features { lists: true, ..Features::EVERYTHING };

    /// [`Features::EVERYTHING`], with retries of composites and `finally`.
    pub const GUARDS: Features = Features { guards: true, ..Features::EVERYTHING };

    /// [`Features::GUARDS`], with states that wait.
    pub const WAITS: Features = Features { waits: true, ..Features::GUARDS };

    /// [`Features::WAITS`], with watched states, and with `find`.
    pub const WATCHED: Features = Features { watched: true, finds: true, ..Features::WAITS };

    /// [`Features::WATCHED`], with anytime actions.
    pub const ANYTIME: Features = Features { anytime: true, ..Features::WATCHED };

    /// [`Features::WATCHED`], with more ways out.
    pub const WAYS_OUT: Features = Features { ways_out: true, ..Features::WATCHED };

    /// [`Features::WAYS_OUT`], with outputs of all composite states.
    pub const OUTPUTS: Features = Features { outputs: true, ..Features::WAYS_OUT };

    /// What a task file can express for actions whose annotations are partly in the catalogue ([`crate::inherited()`]).
    pub const INHERITED: Features = Features {
        transitions: false,
        preemptive: false,
        facts: true,
        keys: true,
        amounts: true,
        supplies: true,
        estimates: true,
        ..Features::ALL
    };

    /// Imprecise motions that fail, in programs that never read the world: a failure then leads to the same place in both modes,
    /// whatever younger motions have done meanwhile.
    pub const IMPRECISE: Features = Features {
        effects: false,
        measured: false,
        blind: true,
        weak: true,
        libraries: true,
        estimates: true,
        ..Features::ALL
    };
}
