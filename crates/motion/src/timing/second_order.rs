//! A path timed within limits of velocity and acceleration (`reachability`), on a grid; and how close together the points have to be at which the third
//! order is solved.
//!
//! On the grid s̈ is constant between two points. Where it should change inside a cell, that costs time: about |Δs̈| h² / 8 ṡ, if the cell takes the time
//! h. A refined grid has cells that cost little. The third order needs cells that are short beside the time in which jerk makes the change of
//! acceleration, or so short that they cost little; away from the changes cells may grow. So the number of cells follows from what happens on the path,
//! not from how long it takes.

use super::follow::Bounds;
use super::path::Path;
use super::reachability::{Grid, squares};
use crate::trajectory::Knot;

/// Minimum number of grid points on a path and on each of its segments, and maximum change of direction between neighbouring points, in
/// radians.
const GRID: f64 = 240.0;
const GRID_SEGMENT: f64 = 6.0;
const GRID_TURN: f64 = 0.04;

/// The part of the duration that a cell of a refined grid may cost, the number of rounds, and the parts of a cell per round at most.
const GRID_LOSS: f64 = 2e-6;
const REFINEMENTS: usize = 6;
const PARTS: f64 = 4.0;

/// The part of the time in which jerk makes a change of acceleration that a cell of the third order takes there.
const RESOLUTION: f64 = 0.2;
/// The part of the duration that a change of acceleration may cost if cells are longer.
const LOSS: f64 = 1e-5;
/// How much longer cells get per time from a change of acceleration.
const GROWTH: f64 = 0.15;

/// A path timed within limits of velocity and acceleration.
pub(crate) struct Second<const N: usize> {
    grid: Grid<N>,
    /// ṡ² at the points of the grid.
    pub(crate) squares: Vec<f64>,
    times: Vec<f64>,
}

impl<const N: usize> Second<N> {
    /// On a grid that is even in each segment of the path.
    pub(crate) fn of(path: &Path<N>, bounds: &Bounds<N>, density: f64) -> Second<N> {
        let mut grid = Grid { s: vec![0.0], points: vec![path.segments()[0].at(0.0)] };
        for (segment, start) in path.segments().iter().zip(path.breaks()) {
            let share = GRID * segment.length / path.length();
            let turn = segment.length * segment.sharpest() / GRID_TURN;
            let count = (share.max(GRID_SEGMENT).max(turn) * density).ceil();
            for i in 1..=count as usize {
                let along = segment.length * i as f64 / count;
                grid.s.push(start + along);
                grid.points.push(segment.at(along));
            }
        }
        Second::on(grid, bounds)
    }

    fn on(grid: Grid<N>, bounds: &Bounds<N>) -> Second<N> {
        let fastest: Vec<f64> = grid.points.iter().map(|point| bounds.fastest(point)).collect();
        let squares = squares(&grid, &fastest, &bounds.velocities, &bounds.accelerations);
        let mut times = vec![0.0];
        for (i, pair) in squares.windows(2).enumerate() {
            let mean = (pair[0].sqrt() + pair[1].sqrt()).max(1e-9) / 2.0;
            times.push(times[i] + (grid.s[i + 1] - grid.s[i]) / mean);
        }
        Second { grid, squares, times }
    }

    /// On a grid whose cells are divided where s̈ changes.
    pub(crate) fn refined(mut self, path: &Path<N>, bounds: &Bounds<N>) -> Second<N> {
        for _ in 0..REFINEMENTS {
            let allowed = GRID_LOSS * self.lasts_s();
            let mut grid = Grid { s: vec![0.0], points: vec![self.grid.points[0]] };
            for i in 0..self.times.len() - 1 {
                let (from, to) = (self.grid.s[i], self.grid.s[i + 1]);
                let lasts = self.times[i + 1] - self.times[i];
                let costs = self.change(i).max(self.change(i + 1)) * lasts.powi(3) / (8.0 * (to - from));
                let parts = (costs / allowed).sqrt().ceil().clamp(1.0, PARTS);
                for part in 1..parts as usize {
                    let s = from + (to - from) * part as f64 / parts;
                    grid.s.push(s);
                    grid.points.push(path.at(s));
                }
                grid.s.push(to);
                grid.points.push(self.grid.points[i + 1]);
            }
            if grid.s.len() == self.grid.s.len() {
                break;
            }
            self = Second::on(grid, bounds);
        }
        self
    }

    /// How much s̈ changes at a point of the grid; at the ends from and to zero.
    fn change(&self, i: usize) -> f64 {
        let in_cell =
            |i: usize| (self.squares[i + 1] - self.squares[i]) / (2.0 * (self.grid.s[i + 1] - self.grid.s[i]));
        let before = if i == 0 { 0.0 } else { in_cell(i - 1) };
        let after = if i + 1 == self.times.len() { 0.0 } else { in_cell(i) };
        (after - before).abs()
    }

    pub(crate) fn lasts_s(&self) -> f64 {
        self.times[self.times.len() - 1]
    }

    pub(crate) fn knots(&self) -> Vec<Knot<[f64; N]>> {
        let knot = |i: usize| Knot {
            time_s: self.times[i],
            positions: self.grid.points[i].position,
            velocities: self.grid.points[i].first.map(|d| d * self.squares[i].sqrt()),
        };
        (0..self.times.len()).map(knot).collect()
    }

    /// How long a cell of the third order may take at each point of the grid.
    pub(crate) fn steps_s(&self, bounds: &Bounds<N>) -> Vec<f64> {
        let last = self.times.len() - 1;
        let allowed = LOSS * self.lasts_s();
        let step = |i: usize| {
            let change = self.change(i);
            let first = &self.grid.points[i].first;
            let jerking = (0..N).map(|j| change * first[j].abs() / bounds.jerks[j]).fold(0.0, f64::max);
            let (before, after) = (i.saturating_sub(1), (i + 1).min(last));
            let speed = (self.grid.s[after] - self.grid.s[before]) / (self.times[after] - self.times[before]);
            (RESOLUTION * jerking).max((8.0 * allowed * speed / change).sqrt())
        };
        let mut steps: Vec<f64> = (0..=last).map(step).collect();
        let grown = |i: usize, step: f64| step + GROWTH * (self.times[i + 1] - self.times[i]);
        for i in 0..last {
            steps[i + 1] = steps[i + 1].min(grown(i, steps[i]));
        }
        for i in (0..last).rev() {
            steps[i] = steps[i].min(grown(i, steps[i + 1]));
        }
        steps
    }

    /// For points of the path in order.
    pub(crate) fn cursor(&self) -> Cursor<'_> {
        Cursor { s: &self.grid.s, index: 0 }
    }
}

/// Linear interpolation between the points of a grid, at points of the path in order.
pub(crate) struct Cursor<'g> {
    s: &'g [f64],
    index: usize,
}

impl Cursor<'_> {
    /// The values of functions at s, which is not before the last one, from those at the points of the grid.
    pub(crate) fn at<const F: usize>(&mut self, s: f64, functions: [&[f64]; F]) -> [f64; F] {
        while self.index + 2 < self.s.len() && self.s[self.index + 1] < s {
            self.index += 1;
        }
        let (from, to) = (self.s[self.index], self.s[self.index + 1]);
        let share = ((s - from) / (to - from)).clamp(0.0, 1.0);
        functions.map(|values| values[self.index] + share * (values[self.index + 1] - values[self.index]))
    }
}
