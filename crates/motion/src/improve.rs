//! Anytime improvement: as long as there is time, the path gets shorter.
//!
//! Four ways, chosen at random: shortcuts; moved corners; other postures at the goal that the present path can turn to; and
//! a new search among the postures that could be part of a shorter path at all (the ellipsoid between start and goal,
//! Gammell et al., 2014). The best path is never lost.

use crate::collision::{Contact, distance};
use crate::pace::{Pace, Progress, Stop};
use crate::plan::{Candidate, Goal, Planning, Way};
use crate::robot::Joints;
use crate::search::search;
use crate::shorten::{length, move_corner, point, shortcut};
use rand::RngExt;

/// The most goal postures kept.
const MAX_CANDIDATES: usize = 64;

/// Iterations of one new search.
const SEARCH_ITERATIONS: usize = 200;

/// Draws of a posture within the ellipsoid before one outside is taken.
const MAX_DRAWS: usize = 50;

/// Shortcuts tried on a path that a new search found.
const SHORTCUTS_AFTER_SEARCH: usize = 60;

/// A path must have become this much shorter to be worth a word, in radians.
const LEAST_REPORT_RAD: f64 = 1e-3;

/// Improves `best` for at most so many iterations; `departed_rad` is the length of what lies before it.
pub(crate) fn improve(
    planning: &mut Planning<'_>,
    best: &mut Way,
    departed_rad: f64,
    iterations: usize,
    pace: &mut Pace<'_>,
) -> Result<(), Stop> {
    let mut reported = total(planning, best);
    for _ in 0..iterations {
        pace.iteration()?;
        match planning.random.random_range(0..100) {
            0..45 => {
                shortcut(&mut best.path, &mut planning.checker, &mut planning.random);
            }
            45..80 => {
                move_corner(&mut best.path, &mut planning.checker, &mut planning.random);
            }
            80..97 => turn_to_another_goal(planning, best),
            _ => search_again(planning, best, pace)?,
        }
        let now = total(planning, best);
        if now < reported - LEAST_REPORT_RAD {
            reported = now;
            pace.report(Progress::Shorter { length_rad: departed_rad + now })?;
        }
    }
    Ok(())
}

fn total(planning: &Planning<'_>, way: &Way) -> f64 {
    length(&way.path) + planning.candidates[way.candidate].length_rad
}

/// Leaves the path somewhere for another posture at the goal, known or new.
fn turn_to_another_goal(planning: &mut Planning<'_>, best: &mut Way) {
    if planning.random.random_bool(0.5)
        && planning.candidates.len() < MAX_CANDIDATES
        && let Some(candidate) = new_candidate(planning, best)
    {
        planning.candidates.push(candidate);
    }
    let other = planning.random.random_range(0..planning.candidates.len());
    if other == best.candidate {
        return;
    }
    let known = total(planning, best);
    let along = planning.random.random_range(0.0..=1.0) * length(&best.path);
    let (from, after) = point(&best.path, along);
    let candidate = &planning.candidates[other];
    if along + distance(&from, candidate.entry()) + candidate.length_rad < known - 1e-4
        && planning.checker.edge_is_free(&from, candidate.entry(), Contact::None)
    {
        best.path.truncate(after);
        best.path.extend([from, *candidate.entry()]);
        best.candidate = other;
    }
}

/// A posture at the goal that a shorter path could lead to.
fn new_candidate(planning: &mut Planning<'_>, best: &Way) -> Option<Candidate> {
    let goal = planning.goals[planning.random.random_range(0..planning.goals.len())];
    let Goal::Pose(pose) = goal else { return None };
    let start = best.path[0];
    let (near, _) = point(&best.path, planning.random.random_range(0.0..=1.0) * length(&best.path));
    let mut seed = near;
    for q in &mut seed {
        *q += planning.random.random_range(-0.5..0.5);
    }
    let posture = planning.solver.descend(&pose, &seed, Some(&near))?;
    if distance(&start, &posture) >= total(planning, best) * 1.1 {
        return None;
    }
    let candidate = planning.candidate(&posture).ok()?;
    (distance(&start, candidate.entry()) + candidate.length_rad < total(planning, best)).then_some(candidate)
}

/// Searches from scratch where a shorter path could run.
fn search_again(planning: &mut Planning<'_>, best: &mut Way, pace: &mut Pace<'_>) -> Result<(), Stop> {
    let bound = total(planning, best);
    let start = best.path[0];
    let shorter = |c: &Candidate| distance(&start, c.entry()) + c.length_rad < bound - 1e-4;
    let useful: Vec<usize> = (0..planning.candidates.len()).filter(|i| shorter(&planning.candidates[*i])).collect();
    if useful.is_empty() {
        return Ok(());
    }
    let entries: Vec<Joints> = useful.iter().map(|i| *planning.candidates[*i].entry()).collect();
    let (solver, random) = (&planning.solver, &mut planning.random);
    let mut sample = || {
        let mut posture = solver.random(random);
        for _ in 0..MAX_DRAWS {
            let goal = &entries[random.random_range(0..entries.len())];
            // About the straight line, as wide as the bound leaves room for.
            let (along, room) = (
                random.random_range(0.0..=1.0),
                0.5 * (bound.powi(2) - distance(&start, goal).powi(2)).max(0.0).sqrt(),
            );
            posture = solver.near_line(&start, goal, along, room, random);
            if distance(&start, &posture) + distance(&posture, goal) < bound {
                break;
            }
        }
        posture
    };
    let found = search(&mut planning.checker, &start, &entries, SEARCH_ITERATIONS, &mut sample, pace)?;
    if let Some((path, index)) = found {
        let mut way = Way { path, candidate: useful[index] };
        for _ in 0..SHORTCUTS_AFTER_SEARCH {
            pace.poll()?;
            shortcut(&mut way.path, &mut planning.checker, &mut planning.random);
        }
        if total(planning, &way) < bound {
            *best = way;
        }
    }
    Ok(())
}
