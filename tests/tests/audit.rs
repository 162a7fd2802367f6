//! Every method of every server that changes something leaves a record in the audit log, with who asked for it and how it ended. Which
//! methods change something is read from the proto, so that none is forgotten.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

#[path = "../../crates/proto/tests/support/mod.rs"]
mod messages;
#[path = "support/servers.rs"]
mod servers;

use messages::Schema;
use ratn_daemon::access::{LiveAccess, Role};
use ratn_worker::audit;
use servers::{ROLES, call, methods, only, servers};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use tokio_util::sync::CancellationToken;
use tracing::field::{Field, Visit};
use tracing_subscriber::layer::{Context, Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;

/// The fields of a record, by name.
type Record = BTreeMap<&'static str, String>;

/// What was written down, in order.
#[derive(Debug, Clone, Default)]
struct Records(Arc<Mutex<Vec<Record>>>);

struct Fields(Record);

impl Visit for Fields {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        self.0.insert(field.name(), format!("{value:?}"));
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        self.0.insert(field.name(), value.to_owned());
    }
}

impl<S: tracing::Subscriber> Layer<S> for Records {
    fn on_event(&self, event: &tracing::Event<'_>, _: Context<'_, S>) {
        if event.metadata().target() == audit::TARGET {
            let mut fields = Fields(Record::new());
            event.record(&mut fields);
            self.0.lock().unwrap().push(fields.0);
        }
    }
}

/// What a call of a method is in the log, and a part of what is said of it.
fn record_of(path: &str) -> (&'static str, &'static str) {
    match path.trim_start_matches("/ratn.v1.") {
        "ResourceService/KeepAlive" => ("open_session", r#""client":"a""#),
        "ResourceService/Session" => ("acquire", ""),
        "ResourceService/Create" => ("create", r#""kind":"a""#),
        "ResourceService/Consume" => ("consume", r#""session":"a""#),
        "ResourceService/Delete" => ("delete", r#""target":"a""#),
        "ResourceService/Acquire" | "ResourceService/Block" => ("acquire", r#""session":"a""#),
        "ResourceService/Withdraw" => ("withdraw", r#""session":"a""#),
        "ResourceService/Release" => ("release", r#""lease":"#),
        "ResourceService/ConfirmStandstill" => ("confirm_standstill", r#""resource":"a""#),
        "ResourceService/EndTask" => ("end_task", r#""session":"a""#),
        "ResourceService/ReportShortage" => ("report_shortage", r#""kind":"a""#),
        "WorldPoolService/Commit" => ("commit", r#""writer":"a""#),
        "WorldPoolService/Project" => ("project", r#""base_revision":"#),
        "WorldPoolService/Release" => ("release_projection", r#""projection":"#),
        "ProcessService/Spawn" => ("spawn", r#""template":"a""#),
        "ProcessService/Stop" => ("stop", r#""worker":"a""#),
        "ProcessService/Restart" => ("restart", r#""target":"a""#),
        "ProcessService/Scale" => ("scale", r#""template":"a""#),
        "ProcessService/Drain" => ("drain", r#""undo":"#),
        "ActionService/Execute" | "ActionService/Attach" | "ActionService/Perform" => ("goal", r#""goal":"a""#),
        "ActionService/Cancel" => ("cancel", r#""goal":"a""#),
        "SafetyService/EmergencyStop" => ("emergency_stop", r#""reason":"a""#),
        "SafetyService/ClearEmergencyStop" => ("clear_emergency_stop", ""),
        "SafetyService/Hold" => ("hold", r#""reason":"a""#),
        "SafetyService/GoOn" => ("go_on", ""),
        "RunService/SendSignal" => ("signal", r#""signal":"a""#),
        "RunService/SendAnswer" => ("answer", r#""choice":"a""#),
        "RunService/SetBreakpoint" => ("set_breakpoint", r#""state":"a""#),
        "RunService/ClearBreakpoint" => ("clear_breakpoint", r#""state":"a""#),
        "CellService/Reset" => ("reset", r#""seed":"#),
        "CellService/InjectFault" => ("inject_fault", r#""fault":"a""#),
        "CellService/PutBack" => ("put_back", ""),
        other => panic!("{other} changes something: what is written of it?"),
    }
}

/// A look for whoever may administer, a watch of what is missing, and a question about an earlier request.
const CHANGE_NOTHING: [&str; 3] =
    ["/ratn.v1.CellService/Save", "/ratn.v1.ResourceService/WatchDemand", "/ratn.v1.ResourceService/Recall"];
/// Their examples are several questions in one, of which only the last counts.
const OVER_A_STREAM: [&str; 2] = ["/ratn.v1.ResourceService/Session", "/ratn.v1.WorldPoolService/Calls"];

#[tokio::test(flavor = "multi_thread")]
async fn every_method_that_changes_something_leaves_a_record_of_who_and_what() {
    let records = Records::default();
    tracing_subscriber::registry().with(records.clone()).init();
    let (place, end) = (tempfile::tempdir().unwrap(), CancellationToken::new());
    let access = LiveAccess::new(only(&[Role::Operator]));
    let servers = servers(place.path(), &access, &end).await;
    let (schema, methods) = (Schema::read(), methods());
    let who = format!("uid {}", nix::unistd::geteuid());
    let (mut written, mut wrong) = (0, Vec::new());
    for server in &servers {
        let channel = &server.channels[ROLES.len() - 1];
        for (path, request, _) in &schema.methods {
            let (service, method) = path.trim_start_matches('/').split_once('/').unwrap();
            let said = methods[service].iter().find(|(name, _)| name == method).and_then(|(_, access)| access.clone());
            let serves = servers::serves(channel, service).await;
            let looks = said.as_deref() == Some("ACCESS_LOOK") || CHANGE_NOTHING.contains(&path.as_str());
            if !serves || looks || OVER_A_STREAM.contains(&path.as_str()) {
                continue;
            }
            records.0.lock().unwrap().clear();
            let answer = call(channel, path, schema.example(request)).await;
            let (operation, what) = record_of(path);
            let of_it = |record: &Record| {
                record["operation"] == operation && record["what"].contains(what) && record["who"] == who
            };
            let there = records.0.lock().unwrap().clone();
            written += 1;
            if !there.iter().any(of_it) {
                wrong.push(format!("{} {path}: {answer:?} left {there:?}", server.name));
            }
        }
    }
    assert!(wrong.is_empty(), "{} of {written}:\n{}", wrong.len(), wrong.join("\n"));
    assert!(written > 25, "only {written} methods change something: is the schema read?");
    end.cancel();
}
