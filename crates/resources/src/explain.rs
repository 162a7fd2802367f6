//! Explanations: which resources a waiting request lacks, and which leases and requests are in its way.

use crate::assignment::{Assignment, Available};
use crate::id::{SessionId, WaiterId};
use crate::pool::Pool;
use crate::queue::Waiter;
use crate::resource::Units;
use crate::turn::Standing;
use ratn_model::id::LeaseId;
use ratn_model::resource::{Quantity, Requirement, ResourceOperation};
use ratn_model::time::Timestamp;
use std::fmt;
use std::time::Duration;

/// Maximum number of holders, and of waiters ahead, that an obstacle names.
const MAX_NAMED: usize = 8;

/// Why a waiter is still in the queue.
#[derive(Debug, Clone, PartialEq)]
pub struct Explanation {
    /// The waiter.
    pub waiter: WaiterId,
    /// The number of waiters that are served before it.
    pub ahead: usize,
    /// Since when it, or the request that it replaces, has waited.
    pub asked: Timestamp,
    /// The standing of its session.
    pub standing: Standing,
    /// The obstacles, in the order of its requirements.
    pub obstacles: Vec<Obstacle>,
}

/// The obstacle to one requirement.
#[derive(Debug, Clone, PartialEq)]
pub enum Obstacle {
    /// No resource of the kind exists.
    MissingKind {
        /// The requirement.
        requirement: String,
        /// The kind.
        kind: String,
        /// Why no provider creates one, as reported by the providers.
        reasons: Vec<String>,
    },
    /// Resources of the kind exist, but too few that fit.
    TooFew {
        /// The requirement.
        requirement: String,
        /// The number of existing units that fit.
        exist: Quantity,
        /// How many of these units would serve this requirement beside the others of its request, if nobody held any.
        of_use: Quantity,
        /// Whether it asks for a fraction of a unit, and everything that fits is only given in whole units.
        undivided: bool,
        /// Why no provider creates more, as reported by the providers.
        reasons: Vec<String>,
    },
    /// Enough exists, but others hold it.
    Held {
        /// The requirement.
        requirement: String,
        /// The holders: lease, session, and purpose.
        holders: Vec<(LeaseId, SessionId, String)>,
        /// Units left by ended leases: lease, resource, the provider that has to confirm standstill, and its bound.
        ending: Vec<(LeaseId, String, Option<SessionId>, Duration)>,
    },
    /// Enough is free, but it is reserved for waiters ahead.
    Reserved {
        /// The requirement.
        requirement: String,
        /// The waiters ahead that want the same kind.
        waiters: Vec<WaiterId>,
    },
}

impl Explanation {
    /// Whether it would be served if others released everything: all that it wants exists.
    pub fn is_hopeful(&self) -> bool {
        let is_there = |one: &Obstacle| !matches!(one, Obstacle::MissingKind { .. } | Obstacle::TooFew { .. });
        self.obstacles.iter().all(is_there)
    }

    /// The leases that hold what it lacks.
    pub fn held_by(&self) -> impl Iterator<Item = LeaseId> {
        self.obstacles
            .iter()
            .flat_map(|obstacle| match obstacle {
                Obstacle::Held { holders, .. } => holders.as_slice(),
                _ => &[],
            })
            .map(|(lease, ..)| *lease)
    }
}

impl Pool {
    /// Why a waiter waits; `None` if it is not in the queue.
    pub fn explain(&self, id: WaiterId) -> Option<Explanation> {
        self.explained(id).map(|(explanation, _)| explanation)
    }

    /// The same, with the number of resources and waiters that were read.
    pub(crate) fn explained(&self, id: WaiterId) -> Option<(Explanation, usize)> {
        let waiter = self.queue.get(id)?;
        let ahead = self.queue.order.range(..waiter.place(id)).count();
        let requirements: Vec<&Requirement> = waiter.request.requirements.iter().collect();
        // Including what others have reserved: no waiter behind this one has reserved anything that it wants.
        let available = Available::FreeTo(&self.queue.reserved, &waiter.reserved);
        let free = Assignment::of(&self.resources, available, &requirements);
        let unreserved = Assignment::of(&self.resources, Available::Free(&Units::new()), &requirements);
        let existing = Assignment::of(&self.resources, Available::Existing, &requirements);
        let mut looked_at = ahead + free.looked_at + unreserved.looked_at + existing.looked_at;
        let obstacles = (0..requirements.len())
            .filter(|index| !free.missing[*index].is_zero())
            .map(|index| {
                let requirement = requirements[index];
                // Twice all resources of the kind, or the waiters ahead.
                looked_at += 2 * self.resources.count(&requirement.kind) + ahead;
                let held = !unreserved.missing[index].is_zero();
                self.obstacle(id, requirement, existing.missing[index], held)
            })
            .collect();
        let (asked, standing) = (waiter.asked, self.standing(&waiter.request.session));
        Some((Explanation { waiter: id, ahead, asked, standing, obstacles }, looked_at))
    }

    /// `lacking`: the amount that would be missing even if nobody held anything. `held`: others hold what is missing now.
    fn obstacle(&self, id: WaiterId, requirement: &Requirement, lacking: Quantity, held: bool) -> Obstacle {
        let text = requirement.to_string();
        if !self.resources.has_kind(&requirement.kind) {
            let reasons = self.shortages_of(requirement);
            Obstacle::MissingKind { requirement: text, kind: requirement.kind.clone(), reasons }
        } else if !lacking.is_zero() {
            let undivided = !requirement.count.is_whole() && self.resources.divisible(requirement) == 0;
            Obstacle::TooFew {
                requirement: text,
                exist: self.resources.quantity(requirement),
                of_use: requirement.count.saturating_sub(lacking),
                undivided,
                reasons: self.shortages_of(requirement),
            }
        } else if held {
            let holders = self
                .resources
                .fitting(requirement)
                .flat_map(|(_, resource)| resource.holders.iter())
                .filter_map(|(lease, _)| {
                    self.leases.get(lease).map(|r| (*lease, r.session.clone(), r.purpose.to_string()))
                })
                .take(MAX_NAMED)
                .collect();
            Obstacle::Held { requirement: text, holders, ending: self.ending_of(requirement) }
        } else {
            let wants = |waiter: &Waiter| {
                waiter.request.requirements.iter().any(|r| {
                    self.resources.family(&r.kind) == self.resources.family(&requirement.kind)
                        && r.operation != ResourceOperation::Exists
                })
            };
            let waiters = self
                .queue
                .iter()
                .take_while(|(other, _)| *other != id)
                .filter(|(_, waiter)| wants(waiter))
                .map(|(other, _)| other)
                .take(MAX_NAMED)
                .collect();
            Obstacle::Reserved { requirement: text, waiters }
        }
    }
}

impl Pool {
    /// Units that ended leases have left of matching resources.
    fn ending_of(&self, requirement: &Requirement) -> Vec<(LeaseId, String, Option<SessionId>, Duration)> {
        let fitting = self.resources.fitting(requirement).filter(|_| !self.ending.is_empty());
        let left = fitting.flat_map(|(slot, resource)| {
            resource.holders.iter().filter_map(move |(lease, units)| {
                let ending = self.ending.get(lease)?.view(*lease, slot, *units, self.now);
                Some((*lease, resource.description.id.clone(), resource.owner.clone(), ending.within))
            })
        });
        left.take(MAX_NAMED).collect()
    }
}

impl fmt::Display for Explanation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, obstacle) in self.obstacles.iter().enumerate() {
            if i > 0 {
                f.write_str("; ")?;
            }
            write!(f, "{obstacle}")?;
        }
        if self.obstacles.is_empty() {
            write!(f, "{} requests before it", self.ahead)?;
        }
        Ok(())
    }
}

impl fmt::Display for Obstacle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Obstacle::MissingKind { requirement, kind, reasons } => {
                write!(f, "`{requirement}`: no resource of kind {kind} exists")?;
                reasons.iter().try_for_each(|reason| write!(f, " ({reason})"))
            }
            Obstacle::TooFew { requirement, exist, of_use, undivided, reasons } => {
                match (exist == of_use, undivided) {
                    (true, _) => write!(f, "`{requirement}`: only {exist} units that fit exist")?,
                    (false, true) => write!(f, "`{requirement}`: what fits is given in whole units only")?,
                    (false, false) => write!(
                        f,
                        "`{requirement}`: of the {exist} units that fit only {of_use} can be given beside what else the request asks for"
                    )?,
                }
                reasons.iter().try_for_each(|reason| write!(f, " ({reason})"))
            }
            Obstacle::Held { requirement, holders, ending } => {
                write!(f, "`{requirement}`: ")?;
                for (i, (lease, session, purpose)) in holders.iter().enumerate() {
                    let separator = if i == 0 { "held by " } else { ", " };
                    let purpose = if purpose.is_empty() { String::new() } else { format!(" for {purpose}") };
                    write!(f, "{separator}{lease} of {session}{purpose}")?;
                }
                for (i, (lease, resource, provider, within)) in ending.iter().enumerate() {
                    let separator = if i == 0 && holders.is_empty() { "" } else { ", " };
                    let provider = provider.as_ref().map_or_else(|| "an operator".to_owned(), ToString::to_string);
                    write!(
                        f,
                        "{separator}{lease} is ending: waits for {provider} to confirm that {resource} stands still, "
                    )?;
                    write!(f, "up to {} ms", within.as_millis())?;
                }
                Ok(())
            }
            Obstacle::Reserved { requirement, waiters } => {
                write!(f, "`{requirement}`: reserved for ")?;
                for (i, waiter) in waiters.iter().enumerate() {
                    write!(f, "{}{waiter}", if i == 0 { "" } else { ", " })?;
                }
                Ok(())
            }
        }
    }
}
