//! The paper's Table I and Table II: the example tasks, executed with their estimated durations.

use crate::run::{Run, RunError, Setup, run_looking_ahead};
use crate::timed::TimedProviders;
use ratn_executive::protocol::Mode;
use ratn_model::catalogue::{Catalogue, ResourceOffer};
use ratn_model::diagnostic::Diagnostic;
use ratn_model::parameters::ParameterError;
use ratn_model::program::Program;
use ratn_model::resource::{Quantity, ResourceClass};
use ratn_model::tolerance::Tolerance;
use ratn_model::value::Value;
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// The task of Table I.
pub const FETCH_BOXES: &str = include_str!("../../../examples/fetch_boxes.yaml");
/// The task of Table II.
pub const SET_TABLE: &str = include_str!("../../../examples/set_table.yaml");

/// Number of orders that look-ahead tries whenever much of the remaining work has changed.
const ORDERS: usize = 500;

/// One row, in seconds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// `I` or `II`.
    pub table: &'static str,
    /// The number of boxes, or of bowls and forks: `2B+2F`.
    pub objects: String,
    /// Makespan in HSM mode.
    pub hsm_s: f64,
    /// Makespan in CDTN mode with one motion planner.
    pub cdtn_1mp_s: f64,
    /// Makespan in CDTN mode with two motion planners.
    pub cdtn_2mp_s: f64,
}

/// The paper's figures for a row; `None` if it has none.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Paper {
    /// HSM mode.
    pub hsm_s: f64,
    /// CDTN with one motion planner.
    pub cdtn_1mp_s: Option<f64>,
    /// CDTN with two.
    pub cdtn_2mp_s: f64,
    /// Improvement of CDTN with two planners over HSM mode.
    pub improvement_percent: f64,
}

/// Error: a table could not be replayed.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// An example task does not load.
    #[error("the example task is refused: {}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("; "))]
    Refused(Vec<Diagnostic>),
    /// A parameter does not fit.
    #[error("{0}")]
    Parameter(#[from] ParameterError),
    /// A run failed.
    #[error("{0}")]
    Run(#[from] RunError),
    /// A run ended with another outcome than success.
    #[error("the task ended with {outcome}: {reason}")]
    Outcome {
        /// The outcome.
        outcome: String,
        /// Why.
        reason: String,
    },
}

/// One scenario of a table.
#[derive(Debug, Clone)]
pub struct Scenario {
    /// `I` or `II`.
    pub table: &'static str,
    /// The objects, as in [`Row::objects`].
    pub objects: String,
    /// The paper's figures.
    pub paper: Paper,
    source: &'static str,
    parameters: Vec<(String, String)>,
    boxes: usize,
}

/// The rows of both tables, in the paper's order.
pub fn scenarios() -> Vec<Scenario> {
    let paper = |hsm_s, cdtn_1mp_s, cdtn_2mp_s, improvement_percent| Paper {
        hsm_s,
        cdtn_1mp_s,
        cdtn_2mp_s,
        improvement_percent,
    };
    let boxes = |count: usize, paper| Scenario {
        table: "I",
        objects: count.to_string(),
        paper,
        source: FETCH_BOXES,
        parameters: vec![("boxes".to_owned(), count.to_string())],
        boxes: count,
    };
    let dishes = |each: usize, paper| Scenario {
        table: "II",
        objects: format!("{each}B+{each}F"),
        paper,
        source: SET_TABLE,
        parameters: vec![("bowls".to_owned(), each.to_string()), ("forks".to_owned(), each.to_string())],
        boxes: 0,
    };
    vec![
        boxes(1, paper(81.3, Some(73.5), 72.3, 11.1)),
        boxes(2, paper(123.7, Some(107.3), 97.3, 21.3)),
        boxes(3, paper(164.2, Some(141.5), 116.5, 29.0)),
        dishes(2, paper(169.2, None, 122.9, 27.4)),
        dishes(3, paper(255.4, None, 207.2, 18.9)),
    ]
}

/// Replays both tables.
///
/// # Errors
/// [`TableError`] if an example task is refused or a run does not succeed.
pub fn tables() -> Result<Vec<Row>, TableError> {
    scenarios()
        .iter()
        .map(|scenario| {
            Ok(Row {
                table: scenario.table,
                objects: scenario.objects.clone(),
                hsm_s: rounded(scenario.replay(Mode::Hsm, 1)?.end_s),
                cdtn_1mp_s: rounded(scenario.replay(Mode::Cdtn, 1)?.end_s),
                cdtn_2mp_s: rounded(scenario.replay(Mode::Cdtn, 2)?.end_s),
            })
        })
        .collect()
}

impl Scenario {
    /// One run of the scenario.
    ///
    /// # Errors
    /// As [`tables`].
    pub fn replay(&self, mode: Mode, planners: u32) -> Result<Run, TableError> {
        let catalogue = Catalogue::standard();
        let loaded = ratn_model::load::load(self.source, "example.yaml", &catalogue).map_err(TableError::Refused)?;
        let setup = setup(loaded.program, &self.parameters, mode, planners)?;
        let run = run_looking_ahead(setup, &mut TimedProviders { boxes: self.boxes }, ORDERS)?;
        if run.outcome == ratn_model::program::SUCCESS {
            Ok(run)
        } else {
            Err(TableError::Outcome { outcome: run.outcome, reason: run.reason })
        }
    }
}

fn setup(program: Program, parameters: &[(String, String)], mode: Mode, planners: u32) -> Result<Setup, TableError> {
    let parameters: BTreeMap<String, Value> = program.bind_parameters(parameters)?;
    let mut resources: Vec<(String, ResourceOffer)> = Catalogue::standard().resources.into_iter().collect();
    for (kind, offer) in &mut resources {
        if kind == "PathPlanner" {
            offer.count = planners.into();
        } else if offer.class != ResourceClass::World {
            offer.count = Quantity::ONE;
        }
    }
    Ok(Setup {
        program: Arc::new(program),
        mode,
        parameters,
        seed: 1,
        resources,
        world: Vec::new(),
        tolerance: Tolerance::EXACT,
        latency: Duration::ZERO,
    })
}

fn rounded(seconds: f64) -> f64 {
    (seconds * 1000.0).round() / 1000.0
}
