//! Who may connect, and who may do what: over a Unix socket by uid, over TCP by certificate.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

mod support;

use ratn_daemon::access::{AccessConfig, CertificateAccess, Role, UserAccess};
use ratn_daemon::config::state_directory;
use ratn_daemon::metrics::Metrics;
use ratn_daemon::process_manager::Template;
use ratn_daemon::resource_manager::{self, ResourceManagerConfig};
use ratn_daemon::service::ServiceConfig;
use ratn_proto::v1;
use ratn_proto::v1::resource_service_client::ResourceServiceClient;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::tls::ServerTls;
use ratn_worker::trace::Traced;
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, ExtendedKeyUsagePurpose, IsCa, KeyPair};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use support::{TestSystem, in_time};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tonic::Code;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Identity};
use tonic_types::StatusExt;

/// The pause between two looks at what a daemon has done.
const LOOK_INTERVAL: Duration = Duration::from_millis(20);

type Raw = ResourceServiceClient<Traced>;

fn create(session: &str, class: v1::ResourceClass) -> v1::CreateRequest {
    let resource = v1::Resource { class: class.into(), kind: "Thing".into(), capacity: 1.0, ..Default::default() };
    v1::CreateRequest { request_id: String::new(), session_id: session.into(), resource: Some(resource) }
}

async fn ping(client: &mut Raw, session: &str, ttl_ms: u64) -> Result<v1::KeepAliveResponse, tonic::Status> {
    let ping = v1::KeepAliveRequest { session_id: session.into(), ttl_ms, client: "test".into(), ..Default::default() };
    let mut answers = client.keep_alive(tokio_stream::once(ping)).await?.into_inner();
    answers.message().await.map(|answer| answer.unwrap())
}

async fn manager(system: &TestSystem, listen: Endpoint, service: &ServiceConfig) -> Endpoint {
    start(system, listen, service).await.endpoint
}

/// A manager that can be ended.
struct Started {
    endpoint: Endpoint,
    shutdown: CancellationToken,
    running: JoinHandle<anyhow::Result<()>>,
}

impl Started {
    async fn end(self) {
        self.shutdown.cancel();
        in_time(self.running).await.unwrap().unwrap();
    }
}

async fn start(system: &TestSystem, listen: Endpoint, service: &ServiceConfig) -> Started {
    let config = ResourceManagerConfig { listen, ..Default::default() };
    let (shutdown, metrics) = (CancellationToken::new(), Arc::new(Metrics::new(resource_manager::ROLE)));
    let run = resource_manager::run_as(
        tokio::sync::watch::Sender::new(config).subscribe(),
        system.directory.clone(),
        service.serving(&metrics),
        metrics.clone(),
        shutdown.clone(),
    );
    let running = tokio::spawn(run);
    let endpoint = system.directory.wait_for(resource_manager::ROLE, support::DEADLINE).await.unwrap();
    Started { endpoint, shutdown, running }
}

#[tokio::test]
async fn by_default_a_manager_is_at_a_socket_of_its_directory_and_its_user_is_the_operator() {
    let system = TestSystem::new();
    let endpoint = manager(&system, ResourceManagerConfig::default().listen, &ServiceConfig::default()).await;
    assert!(matches!(&endpoint, Endpoint::Unix(path) if path.ends_with("resource-manager.sock")), "{endpoint}");
    let mut client = Raw::new(system.channels.get(&endpoint).unwrap());
    in_time(client.create(create("", v1::ResourceClass::Module))).await.unwrap();
}

#[tokio::test]
async fn a_user_who_may_only_look_changes_nothing() {
    let system = TestSystem::new();
    let viewer = UserAccess { uid: nix::unistd::geteuid().as_raw(), roles: vec![Role::Viewer] };
    let access = AccessConfig { users: vec![viewer], ..AccessConfig::default() };
    let service = ServiceConfig { access, ..ServiceConfig::default() };
    let endpoint = manager(&system, Endpoint::local(), &service).await;
    let mut client = Raw::new(system.channels.get(&endpoint).unwrap());
    in_time(client.list(v1::ListRequest::default())).await.unwrap();
    let refused = in_time(client.create(create("", v1::ResourceClass::Module))).await.unwrap_err();
    assert_eq!(refused.code(), Code::PermissionDenied);
    assert!(refused.message().contains("may not Create"), "{refused}");
    assert_eq!(in_time(ping(&mut client, "s", 1000)).await.unwrap_err().code(), Code::PermissionDenied);
    let list = in_time(client.list(v1::ListRequest::default())).await.unwrap().into_inner();
    assert_eq!(list.resources, []);
}

#[tokio::test]
async fn who_proves_nothing_is_no_operator() {
    let system = TestSystem::new();
    let endpoint = manager(&system, Endpoint::loopback(), &ServiceConfig::default()).await;
    let mut client = Raw::new(system.channels.get(&endpoint).unwrap());
    let refused = in_time(client.create(create("", v1::ResourceClass::Module))).await.unwrap_err();
    assert_eq!(refused.code(), Code::PermissionDenied);
    in_time(ping(&mut client, "s", 10_000)).await.unwrap();
    in_time(client.create(create("s", v1::ResourceClass::Module))).await.unwrap();
}

#[tokio::test]
async fn an_address_beyond_loopback_is_not_served_without_tls_unless_it_is_said() {
    let system = TestSystem::new();
    let listen: Endpoint = "0.0.0.0:0".parse().unwrap();
    let config = ResourceManagerConfig { listen: listen.clone(), ..Default::default() };
    let run = resource_manager::run(config, system.directory.clone(), CancellationToken::new());
    let refused = in_time(run).await.unwrap_err().to_string();
    assert!(refused.contains("--insecure") && refused.contains("[service.tls]"), "{refused}");
    let service = ServiceConfig { insecure: true, ..ServiceConfig::default() };
    assert!(matches!(manager(&system, listen, &service).await, Endpoint::Tcp { .. }));
}

/// An authority and what it signs.
struct Authority(CertifiedIssuer<'static, KeyPair>);

struct Signed {
    pem: String,
    key: String,
    fingerprint: String,
}

impl Authority {
    fn new() -> Authority {
        let mut params = CertificateParams::new([]).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        Authority(CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap())
    }

    fn sign(&self) -> Signed {
        let key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::new(["localhost".to_owned()]).unwrap();
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        let certificate = params.signed_by(&key, &self.0).unwrap();
        let digest = ring::digest::digest(&ring::digest::SHA256, certificate.der());
        let fingerprint = digest.as_ref().iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(":");
        Signed { pem: certificate.pem(), key: key.serialize_pem(), fingerprint }
    }

    fn client(&self, endpoint: &Endpoint, shown: Option<&Signed>) -> Raw {
        let mut tls =
            ClientTlsConfig::new().domain_name("localhost").ca_certificate(Certificate::from_pem(self.0.pem()));
        if let Some(shown) = shown {
            tls = tls.identity(Identity::from_pem(&shown.pem, &shown.key));
        }
        Raw::new(Traced::new(
            Channel::from_shared(endpoint.to_string()).unwrap().tls_config(tls).unwrap().connect_lazy(),
        ))
    }
}

/// A config under which certificates of an authority are known as `first`, `second` …, each with the role of a task.
fn known_by_certificate(authority: &Authority, own: &Signed, files: &Path, known: &[(&Signed, &str)]) -> ServiceConfig {
    let file = |name: &str, text: &str| {
        let path = files.join(name);
        std::fs::write(&path, text).unwrap();
        path
    };
    let tls = ServerTls {
        cert: file("cert.pem", &own.pem),
        key: file("key.pem", &own.key),
        client_ca: file("ca.pem", &authority.0.pem()),
    };
    let certificate = |(signed, name): &(&Signed, &str)| CertificateAccess {
        fingerprint: Some(signed.fingerprint.clone()),
        host: None,
        name: Some((*name).to_owned()),
        roles: vec![Role::Task],
    };
    let access = AccessConfig { certificates: known.iter().map(certificate).collect(), ..Default::default() };
    ServiceConfig { tls: Some(tls), access, ..ServiceConfig::default() }
}

#[tokio::test]
async fn who_opened_a_session_is_known_after_a_restart_and_nobody_takes_it_over() {
    let (system, files, authority) = (TestSystem::new(), tempfile::tempdir().unwrap(), Authority::new());
    let (own, first, second) = (authority.sign(), authority.sign(), authority.sign());
    let service = known_by_certificate(&authority, &own, files.path(), &[(&first, "first"), (&second, "second")]);
    let listen: Endpoint = "localhost:0".parse().unwrap();
    let before = start(&system, listen.clone(), &service).await;
    in_time(ping(&mut authority.client(&before.endpoint, Some(&first)), "s", 60_000)).await.unwrap();
    before.end().await;

    let after = start(&system, listen, &service).await;
    let mut stranger = authority.client(&after.endpoint, Some(&second));
    for ttl_ms in [60_000, 0] {
        let refused = in_time(ping(&mut stranger, "s", ttl_ms)).await.unwrap_err();
        assert_eq!(refused.code(), Code::PermissionDenied);
        let says = "session `s` belongs to first (certificate), not to second (certificate)";
        assert_eq!(refused.message(), says);
    }
    let end = v1::EndTaskRequest { request_id: String::new(), session_id: "s".into() };
    assert_eq!(in_time(stranger.end_task(end)).await.unwrap_err().code(), Code::PermissionDenied);
    let mut opener = authority.client(&after.endpoint, Some(&first));
    let kept = in_time(ping(&mut opener, "s", 60_000)).await.unwrap();
    assert!(!kept.created, "its session went on");
    let sessions =
        in_time(opener.list_sessions(v1::ListSessionsRequest::default())).await.unwrap().into_inner().sessions;
    assert_eq!(sessions[0].opened_by, "first (certificate)");
    // When it has ended, its id is still the opener's, also after another restart.
    in_time(ping(&mut opener, "s", 0)).await.unwrap();
    let mut running = after;
    for _ in 0..2 {
        let refused = in_time(ping(&mut authority.client(&running.endpoint, Some(&second)), "s", 60_000)).await;
        let refused = refused.unwrap_err();
        let reason = refused.get_details_error_info().unwrap().reason;
        assert_eq!((refused.code(), reason.as_str()), (Code::PermissionDenied, "NOT_YOURS"));
        assert!(refused.message().contains("its id is kept for first (certificate)"), "{refused}");
        running.end().await;
        running = start(&system, "localhost:0".parse().unwrap(), &service).await;
    }
    let mut opener = authority.client(&running.endpoint, Some(&first));
    assert!(in_time(ping(&mut opener, "s", 60_000)).await.unwrap().created);
    running.end().await;
}

#[tokio::test]
async fn a_provider_has_its_resource_also_where_a_task_took_the_id_while_it_was_away() {
    let (system, files, authority) = (TestSystem::new(), tempfile::tempdir().unwrap(), Authority::new());
    let (own, task, cell) = (authority.sign(), authority.sign(), authority.sign());
    let mut service = known_by_certificate(&authority, &own, files.path(), &[(&task, "task"), (&cell, "cell")]);
    service.access.certificates[1].roles = vec![Role::Agent];
    let running = start(&system, "localhost:0".parse().unwrap(), &service).await;
    let arm = |session: &str, class: v1::ResourceClass| {
        let mut create = create(session, class);
        create.resource.as_mut().unwrap().id = "arm@sim".into();
        create
    };
    let mut task = authority.client(&running.endpoint, Some(&task));
    let mut cell = authority.client(&running.endpoint, Some(&cell));
    in_time(ping(&mut task, "t", 60_000)).await.unwrap();
    in_time(ping(&mut cell, "c", 60_000)).await.unwrap();
    in_time(task.create(arm("t", v1::ResourceClass::Task))).await.unwrap();
    let made = in_time(cell.create(arm("c", v1::ResourceClass::Module))).await.unwrap().into_inner().resource.unwrap();
    assert_eq!((made.id.as_str(), made.session_id.as_str()), ("arm@sim", "c"));
    let refused = in_time(task.create(arm("t", v1::ResourceClass::Task))).await.unwrap_err();
    assert_eq!(refused.code(), Code::AlreadyExists, "{refused}");
    running.end().await;
}

#[tokio::test]
async fn over_tls_a_certificate_is_who_one_is_and_nobody_touches_what_is_anothers() {
    let system = TestSystem::new();
    let files = tempfile::tempdir().unwrap();
    let authority = Authority::new();
    let (own, first, second, stranger) = (authority.sign(), authority.sign(), authority.sign(), authority.sign());
    let service = known_by_certificate(&authority, &own, files.path(), &[(&first, "first"), (&second, "second")]);
    let endpoint = manager(&system, "localhost:0".parse().unwrap(), &service).await;
    assert!(matches!(endpoint, Endpoint::Tls { .. }), "{endpoint}");

    // Without a certificate nobody gets in; with one of the authority's that is not named one may look.
    assert!(in_time(authority.client(&endpoint, None).list(v1::ListRequest::default())).await.is_err());
    let other = Authority::new();
    let foreign = other.sign();
    assert!(in_time(authority.client(&endpoint, Some(&foreign)).list(v1::ListRequest::default())).await.is_err());
    let mut client = authority.client(&endpoint, Some(&stranger));
    in_time(client.list(v1::ListRequest::default())).await.unwrap();
    assert_eq!(in_time(ping(&mut client, "x", 1000)).await.unwrap_err().code(), Code::PermissionDenied);

    // The first has a session; the second can neither speak for it, nor prolong it, nor end it.
    let (mut first, mut second) =
        (authority.client(&endpoint, Some(&first)), authority.client(&endpoint, Some(&second)));
    in_time(ping(&mut first, "s", 60_000)).await.unwrap();
    in_time(first.create(create("s", v1::ResourceClass::Task))).await.unwrap();
    // A task offers nobody to give goals to, whatever it calls the resource: who is granted it would give goals there.
    let mut forged = create("s", v1::ResourceClass::Task);
    let resource = forged.resource.as_mut().unwrap();
    (resource.id, resource.kind) = ("0-arm".to_owned(), "Arm".to_owned());
    let here = v1::Value { kind: Some(v1::value::Kind::Text("http://127.0.0.1:1".to_owned())) };
    resource.attributes.insert("endpoint".to_owned(), here);
    let refused = in_time(first.create(forged)).await.unwrap_err();
    assert_eq!(refused.code(), Code::PermissionDenied, "{refused}");
    assert!(refused.message().contains("goals would be given there"), "{refused}");
    // Nor delete what the first created, by what it is.
    in_time(ping(&mut second, "t", 60_000)).await.unwrap();
    let things = v1::Requirement {
        operation: v1::ResourceOperation::Delete.into(),
        kind: "Thing".into(),
        count: 1.0,
        ..Default::default()
    };
    let target = Some(v1::delete_request::Target::Requirement(things));
    let delete = v1::DeleteRequest { session_id: "t".into(), target, ..Default::default() };
    let refused = in_time(second.delete(delete)).await.unwrap_err();
    assert_eq!(refused.code(), Code::PermissionDenied, "{refused}");
    assert!(refused.message().contains("belongs to session s"), "{refused}");
    let lease = v1::BlockRequest {
        session_id: "s".into(),
        requirement: Some(v1::Requirement {
            operation: v1::ResourceOperation::Block.into(),
            kind: "Thing".into(),
            count: 1.0,
            ..Default::default()
        }),
        deadline_ms: 10_000,
        ..Default::default()
    };
    let lease = in_time(first.block(lease)).await.unwrap().into_inner().lease.unwrap();
    let list = in_time(second.list(v1::ListRequest::default())).await.unwrap().into_inner();
    assert_eq!(list.resources[0].holdings[0].opened_by, "first (certificate)");
    let release = v1::ResourceServiceReleaseRequest {
        request_id: String::new(),
        session_id: "s".into(),
        lease_id: lease.id,
        note: String::new(),
        at_rest: true,
    };
    let sessionless = v1::ResourceServiceReleaseRequest { session_id: String::new(), ..release.clone() };
    for refused in [
        in_time(second.release(release.clone())).await.unwrap_err(),
        in_time(second.release(sessionless)).await.unwrap_err(),
        in_time(ping(&mut second, "s", 60_000)).await.unwrap_err(),
        in_time(ping(&mut second, "s", 0)).await.unwrap_err(),
    ] {
        assert_eq!(refused.code(), Code::PermissionDenied, "{refused}");
    }
    let refused = in_time(first.create(create("s", v1::ResourceClass::Module))).await.unwrap_err();
    assert!(refused.message().contains("first (certificate) may not create"), "{refused}");
    assert!(in_time(first.release(release)).await.unwrap().into_inner().released);
}

#[tokio::test]
async fn names_with_control_characters_and_without_end_are_refused() {
    let system = TestSystem::new();
    let endpoint = manager(&system, Endpoint::local(), &ServiceConfig::default()).await;
    let mut client = Raw::new(system.channels.get(&endpoint).unwrap());
    let spoiled: [fn(&mut v1::CreateRequest, String); 6] = [
        |request, name| request.request_id = name,
        |request, name| request.session_id = name,
        |request, name| request.resource.as_mut().unwrap().id = name,
        |request, name| request.resource.as_mut().unwrap().kind = name,
        |request, name| request.resource.as_mut().unwrap().host = name,
        |request, name| {
            let value = v1::Value { kind: Some(v1::value::Kind::Boolean(true)) };
            request.resource.as_mut().unwrap().attributes.insert(name, value);
        },
    ];
    for (i, spoil) in spoiled.iter().enumerate() {
        for name in ["a\u{1b}[2Jb".to_owned(), "line\nfeed".to_owned(), "x".repeat(5_000)] {
            let mut request = create("", v1::ResourceClass::Module);
            spoil(&mut request, name);
            let refused = in_time(client.create(request)).await.unwrap_err();
            assert_eq!(refused.code(), Code::InvalidArgument, "{i}: {refused}");
            assert!(!refused.message().contains(char::is_control), "{i}: {refused:?}");
        }
    }
    let large = v1::ListRequest { kinds: vec!["x".repeat(32 * 1024 * 1024)], ..Default::default() };
    assert_eq!(in_time(client.list(large)).await.unwrap_err().code(), Code::OutOfRange);
}

/// A manager of this user, who is no operator there.
async fn manager_without_operator(system: &TestSystem) -> Started {
    let (uid, roles) = (nix::unistd::geteuid().as_raw(), vec![Role::Viewer, Role::Task, Role::Agent]);
    let access = AccessConfig { users: vec![UserAccess { uid, roles }], ..AccessConfig::default() };
    start(system, Endpoint::local(), &ServiceConfig { access, ..ServiceConfig::default() }).await
}

/// The state in which a session of this id is that of somebody who proves nothing, for an hour.
async fn state_with_a_session_of_another(id: &str) -> TestSystem {
    let elsewhere = TestSystem::new();
    let manager = start(&elsewhere, Endpoint::loopback(), &ServiceConfig::default()).await;
    in_time(ping(&mut Raw::new(elsewhere.channels.get(&manager.endpoint).unwrap()), id, 3_600_000)).await.unwrap();
    manager.end().await;
    elsewhere
}

#[tokio::test(flavor = "multi_thread")]
async fn a_process_manager_whose_session_id_is_anothers_goes_on_with_another_id_and_other_workers() {
    let system = TestSystem::new();
    let template = Template {
        program: Some(env!("CARGO_BIN_EXE_ratn-test-worker").into()),
        args: ["serve", "{id}", "{kind}", "{endpoint_file}"].map(str::to_owned).to_vec(),
        min: 2,
        max: Some(2),
        ..Template::new("planner", "PathPlanner")
    };
    let manager = manager_without_operator(&system).await;
    let processes = system.process_manager(vec![template]).await;
    let before = ["planner-1@compute", "planner-2@compute"];
    // Two workers that a session offers, those of before or others.
    let offers = async |session: &str, those_of_before: bool| {
        let endpoint = system.directory.find(resource_manager::ROLE).unwrap();
        let mut client = Raw::new(system.channels.get(&endpoint).unwrap());
        let kinds = vec!["PathPlanner".to_owned()];
        let own = v1::ListRequest { session_id: session.into(), kinds, ..Default::default() };
        in_time(async {
            loop {
                let listed = client.list(own.clone()).await.map(|listed| listed.into_inner().resources);
                let listed = listed.unwrap_or_default();
                let is_of_before = |resource: &v1::Resource| before.contains(&resource.id.as_str());
                if listed.len() == 2 && listed.iter().all(|one| is_of_before(one) == those_of_before) {
                    return;
                }
                tokio::time::sleep(LOOK_INTERVAL).await;
            }
        })
        .await;
    };
    let file = system.directory.path().join("process-manager.session");
    let first = std::fs::read_to_string(&file).unwrap();
    offers(&first, true).await;
    manager.end().await;

    // The manager comes back with a state in which somebody else has the id.
    let elsewhere = state_with_a_session_of_another(&first).await;
    let state = |system: &TestSystem| state_directory(system.directory.path()).join(resource_manager::ROLE);
    std::fs::remove_dir_all(state(&system)).unwrap();
    std::fs::rename(state(&elsewhere), state(&system)).unwrap();
    let manager = manager_without_operator(&system).await;
    in_time(async {
        while std::fs::read_to_string(&file).unwrap() == first {
            tokio::time::sleep(LOOK_INTERVAL).await;
        }
    })
    .await;
    let second = std::fs::read_to_string(&file).unwrap();
    // Those of before were told of another session, and confirm no lease of what this one offers.
    offers(&second, false).await;
    processes.end().await;
    manager.end().await;
}
