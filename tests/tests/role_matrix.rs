//! Every method of every server, called over the wire in every role: who is let in is exactly whom the option of the method in the proto
//! says. What is expected is read from the descriptors, with roles written down here; nothing of the table in the code is asked.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

#[path = "support/servers.rs"]
mod servers;

use ratn_daemon::access::{LiveAccess, Role};
use ratn_worker::trace::Traced;
use servers::{ROLES, call, methods, only, servers, serves};
use std::collections::{BTreeMap, BTreeSet};
use tokio_util::sync::CancellationToken;
use tonic::Code;

/// Who may, by what the option says.
fn may(access: &str, roles: &[Role]) -> bool {
    use Role::{Agent, Operator, Task, Viewer};
    let who: &[Role] = match access {
        "ACCESS_LOOK" => &[Viewer, Task, Agent, Operator],
        "ACCESS_SESSION" | "ACCESS_CREATE" | "ACCESS_DELETE" | "ACCESS_RELEASE" | "ACCESS_PERFORM" => {
            &[Task, Agent, Operator]
        }
        "ACCESS_CONSUME" | "ACCESS_ACQUIRE" | "ACCESS_PROJECT" | "ACCESS_COMMIT" => &[Task, Operator],
        "ACCESS_ADMINISTER" => &[Operator],
        "ACCESS_PROVIDE" => &[Agent, Operator],
        other => panic!("who may {other}? Say it here"),
    };
    roles.iter().any(|role| who.contains(role))
}

/// Whether the gate let the call in; what the service says of it is its own business.
async fn let_in(channel: &Traced, path: &str) -> bool {
    match call(channel, path, Vec::new()).await {
        Some(Err(status)) if status.code() == Code::PermissionDenied => !status.message().contains("has the roles"),
        Some(Err(status)) => {
            assert_ne!(status.code(), Code::Unimplemented, "{path}");
            true
        }
        Some(Ok(())) | None => true,
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_method_of_every_server_is_open_to_the_roles_that_its_option_says_and_to_nobody_else() {
    let (place, end) = (tempfile::tempdir().unwrap(), CancellationToken::new());
    let access = LiveAccess::new(only(&[Role::Operator]));
    let servers = servers(place.path(), &access, &end).await;
    let methods = methods();

    let (mut served, mut closed) = (BTreeMap::new(), Vec::new());
    for server in &servers {
        for (service, methods) in &methods {
            if serves(&server.channels[ROLES.len() - 1], service).await {
                served.insert((server.name, service), methods);
                closed.extend(methods.iter().filter(|(_, access)| access.is_none()).map(|(name, _)| (service, name)));
            }
        }
    }
    assert!(closed.is_empty(), "these methods say no (access) in the proto: {closed:?}");
    let somewhere: BTreeSet<_> = served.keys().map(|(_, service)| *service).collect();
    assert_eq!(somewhere, methods.keys().collect(), "every service is served here, so that none is forgotten");

    let (mut called, mut wrong) = (0, Vec::new());
    for (i, roles) in ROLES.iter().enumerate() {
        access.replace(only(roles));
        for server in &servers {
            for ((_, service), methods) in served.iter().filter(|((name, _), _)| *name == server.name) {
                for (method, said) in *methods {
                    let path = format!("/{service}/{method}");
                    let (wanted, is) = (may(said.as_ref().unwrap(), roles), let_in(&server.channels[i], &path).await);
                    called += 1;
                    if wanted != is {
                        wrong.push(format!("{} {path} as {roles:?}: let in {is}, to be {wanted}", server.name));
                    }
                }
                let unknown = format!("/{service}/NoSuchMethod");
                let answer = call(&server.channels[i], &unknown, Vec::new()).await.unwrap().unwrap_err();
                if answer.code() != Code::PermissionDenied {
                    wrong.push(format!("{} {unknown} as {roles:?}: {answer}", server.name));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{} of {called}:\n{}", wrong.len(), wrong.join("\n"));
    let each: usize = served.values().map(|methods| methods.len()).sum();
    assert_eq!(called, each * ROLES.len());
    println!("{called} calls of {each} methods of {} servers in {} roles", servers.len(), ROLES.len());
    end.cancel();
}
