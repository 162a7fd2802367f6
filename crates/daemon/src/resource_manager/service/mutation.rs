//! Audit log entries of requests to the pool.

use crate::audit::{self, Mutation};
use ratn_resources::{AcquireRequest, Request};

pub(super) fn of(request: &Request) -> Mutation {
    let session = request.session().map(|session| session.as_str().to_owned()).unwrap_or_default();
    match request {
        Request::Create { spec, .. } => Mutation::Create {
            session,
            resource: spec.id.clone().unwrap_or_default(),
            kind: spec.kind.clone(),
            class: spec.class.to_string(),
        },
        Request::Consume { requirement, .. } => Mutation::Consume { session, requirement: requirement.to_string() },
        Request::Delete { id, .. } => Mutation::Delete { session, target: id.clone() },
        Request::DeleteUnits { requirement, .. } => Mutation::Delete { session, target: requirement.to_string() },
        Request::Release { lease, at_rest, .. } => Mutation::Release { session, lease: lease.0, at_rest: *at_rest },
        Request::ConfirmStandstill { lease, resource, .. } => {
            Mutation::ConfirmStandstill { session, lease: lease.0, resource: resource.clone() }
        }
        Request::EndTask { .. } => Mutation::EndTask { session },
        Request::Acquire(acquire) => of_acquire(acquire),
    }
}

pub(super) fn of_acquire(acquire: &AcquireRequest) -> Mutation {
    Mutation::Acquire {
        session: acquire.session.as_str().to_owned(),
        requirements: acquire.requirements.iter().map(|requirement| audit::cut(&requirement.to_string())).collect(),
        holder: acquire.purpose.clone(),
        priority: acquire.priority,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_model::id::LeaseId;

    #[test]
    fn of_a_release_the_audit_log_says_whether_its_holder_knew_that_nothing_moves() {
        for at_rest in [false, true] {
            let release = Request::Release { session: None, lease: LeaseId(7), at_rest };
            assert_eq!(of(&release), Mutation::Release { session: String::new(), lease: 7, at_rest });
        }
    }
}
