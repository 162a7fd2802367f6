//! Whether a goal's lease is valid: the confirmation by the resource manager, and the statuses of refusals.

use super::goal::LeaseKey;
use crate::access::Caller;
use crate::lease_watch::{Claim, ClaimStatus, GRANT_WAIT, LeaseWatch};
use ratn_model::resource::Lease;
use ratn_proto::types::Goal;
use std::time::Duration;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

/// Delay after which a goal that was refused temporarily may be given again.
const RETRY_DELAY: Duration = Duration::from_millis(250);
/// Reason code (for programs) of a refusal because the resource manager is not heard.
pub(crate) const MANAGER_UNHEARD: &str = "MANAGER_UNHEARD";

/// Reason code (for programs) of a refusal because the driver has not reported that the robot is at rest.
pub(crate) const NOT_AT_REST: &str = "NOT_AT_REST";

/// The authority that confirms leases.
#[derive(Debug, Default)]
pub(super) enum Authority {
    /// None: goals that need a lease are refused.
    #[default]
    Nobody,
    /// The resource manager, through this watch.
    Watch(LeaseWatch),
    /// The giver of the goal: every lease is believed (for tests).
    Claimant,
}

/// Whether a goal's lease is confirmed, as known now.
#[derive(Debug)]
pub(super) enum Confirmation {
    /// The resource manager has confirmed it.
    Confirmed,
    /// The confirmation may still come; if it does not, this is the refusal.
    Awaited(Status),
}

impl Authority {
    /// Checks that the goal's lease holds `resource` and that the caller may give goals under it. Everybody with the role `viewer` can read
    /// leases, so naming a lease proves nothing.
    ///
    /// # Errors
    /// FAILED_PRECONDITION if the lease does not hold the resource; PERMISSION_DENIED if another caller opened the lease's session.
    pub(super) fn confirm(
        &self,
        caller: &Caller,
        goal: &Goal,
        lease: &Lease,
        resource: &str,
    ) -> Result<Confirmation, Status> {
        let watch = match self {
            Authority::Claimant => return Ok(Confirmation::Confirmed),
            Authority::Nobody => {
                let message =
                    format!("{resource} watches no leases, so none is confirmed: give its ActionServer a LeaseWatch");
                return Err(refusal(Code::FailedPrecondition, "NO_LEASE_WATCH", message));
            }
            Authority::Watch(watch) if !watch.resources().iter().any(|watched| watched == resource) => {
                let message = format!("the leases of {resource} are not watched: name it to LeaseWatch::of");
                return Err(refusal(Code::FailedPrecondition, "NOT_WATCHED", message));
            }
            Authority::Watch(watch) => watch,
        };
        let claim = Claim { resource, lease: lease.id, token: lease.token, session: &goal.session };
        let unheard = |why: &str| {
            let message =
                format!("{} of {resource} cannot be confirmed: {why}; nothing was begun, try again", lease.id);
            retry_later(MANAGER_UNHEARD, message)
        };
        Ok(match watch.check(&claim) {
            ClaimStatus::Confirmed => {
                let opened_by = watch.opened_by(resource, lease.id);
                if !caller.may_act_for(&opened_by) {
                    let lease = lease.id;
                    let message = format!(
                        "{lease} of {resource} is held by a session of `{opened_by}`, and the goal is given by `{caller}`: acquire a lease \
                         of your own; only agents and operators give goals under the leases of others"
                    );
                    return Err(refusal(Code::PermissionDenied, "NOT_YOURS", message));
                }
                Confirmation::Confirmed
            }
            ClaimStatus::Refuted(why) => return Err(refusal(Code::FailedPrecondition, "LEASE_REFUTED", why)),
            ClaimStatus::NotHeardOf { listening: true } => {
                let message = format!(
                    "{} ({}) of {resource} is unknown: the resource manager told of no such grant within {} s; acquire it, and send \
                     the lease as it was granted",
                    lease.id,
                    lease.token,
                    GRANT_WAIT.as_secs_f64()
                );
                Confirmation::Awaited(refusal(Code::FailedPrecondition, "LEASE_UNKNOWN", message))
            }
            ClaimStatus::NotHeardOf { listening: false } => {
                Confirmation::Awaited(unheard("the resource manager is not heard just now"))
            }
            ClaimStatus::Unheard(why) => Confirmation::Awaited(unheard(&why)),
            ClaimStatus::NotAtRest => {
                let message = format!(
                    "{resource} begins nothing yet: its driver has not said that nothing moves of what a process before it began; \
                     nothing was begun, try again"
                );
                Confirmation::Awaited(retry_later(NOT_AT_REST, message))
            }
        })
    }

    /// Whether a lease that held `resource` does not hold it any more, given that `newest` holds it now.
    pub(super) fn is_over(&self, resource: &str, (lease, token): LeaseKey, newest: LeaseKey) -> bool {
        match self {
            Authority::Watch(watch) => {
                let claim = Claim { resource, lease, token, session: "" };
                matches!(watch.check(&claim), ClaimStatus::Refuted(_))
            }
            Authority::Nobody | Authority::Claimant => token < newest.1,
        }
    }

    /// The watch, if there is one.
    pub(super) fn watch(&self) -> Option<&LeaseWatch> {
        match self {
            Authority::Watch(watch) => Some(watch),
            Authority::Nobody | Authority::Claimant => None,
        }
    }
}

/// A status with a reason code for programs and a sentence for people.
pub(super) fn refusal(code: Code, reason: &str, message: String) -> Status {
    Status::with_error_details(code, message, ErrorDetails::with_error_info(reason, "ratn", []))
}

/// A status that says that no goal was begun, and that the same goal may be given again after a delay.
pub(super) fn retry_later(reason: &str, message: String) -> Status {
    let mut details = ErrorDetails::with_error_info(reason, "ratn", []);
    details.set_retry_info(Some(RETRY_DELAY));
    Status::with_error_details(Code::Unavailable, message, details)
}
