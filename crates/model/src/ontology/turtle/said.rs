//! Further properties of a predicate, besides its arguments and its value.
//!
//! | | |
//! |---|---|
//! | `a owl:FunctionalProperty` | among the facts that differ in the last argument only, at most one holds |
//! | `ratn:tolerance 0.05` | numbers and joint positions within this difference count as the same |
//! | `ratn:positionTolerance 0.01` | so do poses whose origins are within this distance in metres |
//! | `ratn:angleTolerance 0.1` | and whose rotations differ by at most this angle in radians |
//! | `ratn:geometric true` | the scene is derived from its facts |
//! | `ratn:ttl 30` | a measured fact is stale after this number of seconds |
//! | `ratn:uncertainty "confidence"` | or `"covariance"`: the certainty of measured facts |
//! | `ratn:unit "kg"` | the unit of its numbers |

use super::{Domain, OntologyError, Predicate, Range, literal, wrong};
use crate::ontology::Uncertainty;
use crate::tolerance::Deviation;
use crate::value::Type;
use oxrdf::Term as Node;

/// Limit of a unit's name, in characters.
const MAX_UNIT: usize = 32;

#[derive(Default)]
pub(super) struct More {
    tolerance: Deviation,
    geometric: bool,
    ttl_s: Option<f64>,
    uncertainty: Option<Uncertainty>,
    unit: Option<String>,
}

impl More {
    /// Stores the value of one of these properties; false if there is no such property.
    pub(super) fn takes(&mut self, subject: &str, what: &str, object: &Node) -> Result<bool, OntologyError> {
        let text = || literal(subject, &format!("ratn:{what}"), object);
        let number = || {
            let text = text()?;
            let number = text.parse::<f64>().ok().filter(|x| x.is_finite() && *x >= 0.0);
            number.ok_or_else(|| wrong(subject, format!("`ratn:{what}` is a number from 0, found `{text}`")))
        };
        match what {
            "tolerance" => self.tolerance.number = Some(number()?),
            "positionTolerance" => self.tolerance.position_m = Some(number()?),
            "angleTolerance" => self.tolerance.angle_rad = Some(number()?),
            "geometric" => {
                self.geometric = match text()?.as_str() {
                    "true" => true,
                    "false" => false,
                    other => return Err(wrong(subject, format!("`ratn:geometric` is true or false, found `{other}`"))),
                }
            }
            "ttl" => {
                self.ttl_s = Some(number()?);
                if self.ttl_s == Some(0.0) {
                    return Err(wrong(subject, "`ratn:ttl` is above 0: a fact that is stale at once says nothing"));
                }
            }
            "uncertainty" => {
                self.uncertainty = Some(match text()?.as_str() {
                    "confidence" => Uncertainty::Confidence,
                    "covariance" => Uncertainty::Covariance,
                    other => {
                        let message =
                            format!("`ratn:uncertainty` is \"confidence\" or \"covariance\", found `{other}`");
                        return Err(wrong(subject, message));
                    }
                });
            }
            "unit" => {
                let unit = text()?;
                if unit.is_empty() || unit.chars().count() > MAX_UNIT || unit.chars().any(char::is_control) {
                    return Err(wrong(
                        subject,
                        format!("`ratn:unit` is a short name, found `{}`", unit.escape_debug()),
                    ));
                }
                self.unit = Some(unit);
            }
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// The predicate, if its properties fit its value.
    pub(super) fn predicate(
        self,
        subject: &str,
        domain: Vec<Domain>,
        range: Range,
        functional: bool,
    ) -> Result<Predicate, OntologyError> {
        let More { tolerance, geometric, ttl_s, uncertainty, unit } = self;
        let may_hold = |of: &[Type]| matches!(&range, Range::Type(ty) if holds(ty, of));
        let numbers = [Type::Int, Type::Float, Type::Joints];
        let nothing_of = |what: &str, kind: &str| {
            Err(wrong(subject, format!("`ratn:{what}` is said, and its value holds no {kind}")))
        };
        if functional && domain.is_empty() {
            return Err(wrong(subject, "a functional predicate has a subject, and this one has no arguments"));
        }
        if tolerance.number.is_some() && !may_hold(&numbers) {
            return nothing_of("tolerance", "number");
        }
        if tolerance.position_m.or(tolerance.angle_rad).is_some() && !may_hold(&[Type::Pose]) {
            let what = if tolerance.position_m.is_some() { "positionTolerance" } else { "angleTolerance" };
            return nothing_of(what, "pose");
        }
        if unit.is_some() && !may_hold(&numbers) {
            return nothing_of("unit", "number");
        }
        if uncertainty == Some(Uncertainty::Covariance)
            && !may_hold(&[Type::Int, Type::Float, Type::Joints, Type::Pose])
        {
            return nothing_of("uncertainty", "number or pose to have a covariance");
        }
        Ok(Predicate { domain, range, functional, tolerance, geometric, ttl_s, uncertainty, unit })
    }
}

/// Whether a value of the type may contain a value of one of these types.
fn holds(ty: &Type, of: &[Type]) -> bool {
    match ty {
        Type::Any => true,
        Type::List(element) | Type::Map(element) => holds(element, of),
        Type::Record(fields) => fields.values().any(|field| holds(field, of)),
        other => of.contains(other),
    }
}
