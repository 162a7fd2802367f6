//! What random programs are made of. A failure is looked into with as little as still shows it.

/// What random programs are made of, beside sequences, hierarchies, loops over lists, conditions, routines and all three kinds
/// of actions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Features {
    /// Custom outcomes, handlers of failures, jumps forward and back.
    pub transitions: bool,
    /// `while` and `do … while`.
    pub whiles: bool,
    /// Concurrencies whose regions do not conflict.
    pub regions: bool,
    /// Concurrencies whose first region ends the others.
    pub preemptive: bool,
    /// Scoped variables, assignments, defaults of ports.
    pub variables: bool,
    /// Tries after failures, and timeouts of goals that never answer.
    pub retries: bool,
    /// Numeric preconditions, quantified effects, effects per custom outcome.
    pub effects: bool,
    /// Measured facts that are not as predicted.
    pub measured: bool,
    /// Results that do not depend on the seed; small widths; exceptional outcomes.
    pub speculation: bool,
    /// Facts of no, two and three arguments, individuals, wildcards, queries, records and their fields.
    pub facts: bool,
    /// Keys that come from ports, quantified effects within each other, lists that may be empty.
    pub keys: bool,
    /// Numeric effects of any amount, and such as are made of the fact itself.
    pub amounts: bool,
    /// A predicate that is measured within a tolerance, and ontologies.
    pub tolerance: bool,
    /// Hierarchies that see nothing of what is around them, and parameters.
    pub libraries: bool,
    /// Resources that are chosen by attributes, divisible, scarce, or never come back.
    pub supplies: bool,
    /// Durations, learned ones and learned outcomes; attempts of which none is left.
    pub estimates: bool,
    /// Shapes in which bugs were found that chance does not make: see `generator/patterns`.
    pub patterns: bool,
    /// Emergency stops, refused resources, runs that are resumed.
    pub incidents: bool,
    /// Loops of a thousand, chains of a hundred.
    pub long: bool,
    /// Nothing looks at the world, so that what is done never depends on it.
    pub blind: bool,
    /// What the safety theorem excludes: imprecise exceptions, unordered resources, regions that share facts.
    pub weak: bool,
    /// Parts of expressions stand in comprehensions that come to the same.
    pub lists: bool,
    /// States that are tried again, with something done before; something that is done on every way out.
    pub guards: bool,
    /// States that wait: for a time, a condition, a signal, an answer.
    pub waits: bool,
    /// Motions and hierarchies that are watched: something must hold from their start to their end.
    pub watched: bool,
    /// Queries are said with what they find.
    pub finds: bool,
    /// Actions whose results get better after they were given.
    pub anytime: bool,
    /// Limits of composites, and races whose regions touch nothing of each other; something is done on every way out of states inside of
    /// these and of regions, and being cut short changes the world.
    pub ways_out: bool,
    /// Outputs of conditions, loops and concurrencies, and what different ways give.
    pub outputs: bool,
}

impl Features {
    /// What was made first, under the assumptions of the safety theorem. What its seeds mean never changes.
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

    /// [`Features::ALL`], without those assumptions.
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

    /// [`Features::EVERYTHING`], said with comprehensions.
    pub const LISTS: Features = Features { lists: true, ..Features::EVERYTHING };

    /// [`Features::EVERYTHING`], with retries of composites and what is done on every way out.
    pub const GUARDS: Features = Features { guards: true, ..Features::EVERYTHING };

    /// [`Features::GUARDS`], with states that wait.
    pub const WAITS: Features = Features { waits: true, ..Features::GUARDS };

    /// [`Features::WAITS`], with states that are watched, and with what queries find.
    pub const WATCHED: Features = Features { watched: true, finds: true, ..Features::WAITS };

    /// [`Features::WATCHED`], with results that get better after they were given.
    pub const ANYTIME: Features = Features { anytime: true, ..Features::WATCHED };

    /// [`Features::WATCHED`], with more ways out.
    pub const WAYS_OUT: Features = Features { ways_out: true, ..Features::WATCHED };

    /// [`Features::WAYS_OUT`], with outputs of everything that contains states.
    pub const OUTPUTS: Features = Features { outputs: true, ..Features::WAYS_OUT };

    /// What a task file can say of actions whose catalogue says a part of it ([`crate::inherited()`]).
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

    /// Imprecise motions that fail, in programs that never look at the world: where a failure leads is then the same in both
    /// modes, whatever younger motions have done meanwhile.
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
