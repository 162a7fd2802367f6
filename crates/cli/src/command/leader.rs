//! Which of several servers leads and which stand by, for people and programs. A single address has nothing to show.

use ratn_worker::client::Health;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::tls::ClientTls;
use serde_json::{Value, json};
use std::time::Duration;

/// Timeout of an answer.
const PATIENCE: Duration = Duration::from_millis(500);

/// One of several servers.
#[derive(Debug)]
pub(super) struct Member {
    endpoint: Endpoint,
    /// Whether it leads, else why that is unknown.
    leads: Result<bool, String>,
}

/// The state of each of several servers; empty for a single one.
pub(super) async fn ask(endpoint: &Endpoint, tls: &ClientTls) -> Vec<Member> {
    let members = endpoint.members();
    if members.len() < 2 {
        return Vec::new();
    }
    let asked = members.iter().map(async |member| Member {
        endpoint: member.clone(),
        leads: Health::of(member.clone(), tls).is_serving(PATIENCE).await,
    });
    futures::future::join_all(asked).await
}

/// Text in one line.
pub(super) fn line(role: &str, members: &[Member]) -> String {
    let each = members.iter().map(|Member { endpoint, leads }| match leads {
        Ok(true) => format!("{endpoint} leads"),
        Ok(false) => format!("{endpoint} stands by"),
        Err(why) => format!("{endpoint} does not answer ({why})"),
    });
    let none = if members.iter().any(|member| member.leads == Ok(true)) { "" } else { "; nobody leads" };
    format!("{role}: {}{none}", each.collect::<Vec<_>>().join(", "))
}

pub(super) fn in_json(members: &[Member]) -> Value {
    let one = |Member { endpoint, leads }: &Member| match leads {
        Ok(leads) => json!({ "endpoint": endpoint.to_string(), "leads": leads }),
        Err(error) => json!({ "endpoint": endpoint.to_string(), "leads": false, "error": error }),
    };
    members.iter().map(one).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may panic")]
    use super::*;

    #[test]
    fn who_leads_who_stands_by_and_who_does_not_answer_are_told_apart() {
        let member = |at: &str, leads: Result<bool, &str>| Member {
            endpoint: at.parse().unwrap(),
            leads: leads.map_err(str::to_owned),
        };
        let mut members = [member("a:1", Ok(false)), member("b:1", Ok(true)), member("c:1", Err("refused"))];
        let said = line("resource-manager", &members);
        assert_eq!(
            said,
            "resource-manager: http://a:1 stands by, http://b:1 leads, http://c:1 does not answer (refused)"
        );
        assert_eq!(in_json(&members)[1], json!({ "endpoint": "http://b:1", "leads": true }));
        members[1].leads = Ok(false);
        assert!(line("resource-manager", &members).ends_with("; nobody leads"));
    }
}
