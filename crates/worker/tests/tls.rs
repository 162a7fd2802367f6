//! Certificates that are replaced while a process runs: what its server shows, and what its clients do.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use ratn_worker::access::{Caller, Role};
use ratn_worker::client::{Channels, Health};
use ratn_worker::endpoint::{Endpoint, connect, connect_lazily};
use ratn_worker::gate::{Gate, Identity};
use ratn_worker::server::{Exposure, Services, Serving, bind_as};
use ratn_worker::tls::{ClientTls, LiveServerTls, ServerTls, read_again};
use ratn_worker::trace::Traced;
use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, ExtendedKeyUsagePurpose, IsCa, KeyPair};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio_util::sync::{CancellationToken, DropGuard};
use tonic::codegen::http;
use tonic::transport::{Certificate, Channel, ClientTlsConfig};
use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

/// Nothing here takes this long.
const LONG: Duration = Duration::from_secs(20);

struct Authority(CertifiedIssuer<'static, KeyPair>);

struct Signed {
    pem: String,
    key: String,
    der: Vec<u8>,
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
        Signed { pem: certificate.pem(), key: key.serialize_pem(), der: certificate.der().to_vec() }
    }
}

/// Where the three files of a process are.
struct Files(tempfile::TempDir);

impl Files {
    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write(&self, authority: &Authority, signed: &Signed) {
        for (name, text) in [("ca", &authority.0.pem()), ("cert", &signed.pem), ("key", &signed.key)] {
            std::fs::write(self.path(name), text).unwrap();
        }
    }

    fn client(&self) -> ClientTls {
        ClientTls::read(&self.path("ca"), Some((&self.path("cert"), &self.path("key")))).unwrap()
    }

    fn server(&self) -> LiveServerTls {
        let (cert, key, client_ca) = (self.path("cert"), self.path("key"), self.path("ca"));
        LiveServerTls::new(ServerTls { cert, key, client_ca })
    }
}

/// Lets everybody in, and remembers the certificate of the last caller.
#[derive(Default)]
struct Remembering(Mutex<Option<Vec<u8>>>);

impl Gate for Remembering {
    fn caller(&self, identity: &Identity) -> Caller {
        *self.0.lock().unwrap() = match identity {
            Identity::Certificate { der } => Some(der.to_vec()),
            Identity::User { .. } | Identity::Anonymous => None,
        };
        Caller { name: "somebody".into(), roles: [Role::Viewer].as_slice().into() }
    }

    fn admit(&self, _: &Caller, _: &str, _: &mut http::Extensions) -> Result<(), Status> {
        let is_known = self.0.lock().unwrap().is_some();
        if is_known { Ok(()) } else { Err(Status::unauthenticated("no certificate")) }
    }

    fn answered(&self, _: &str, _: Code, _: Duration) {}
}

async fn ask(channel: Traced) -> Result<(), Status> {
    let check = HealthCheckRequest { service: String::new() };
    tokio::time::timeout(LONG, HealthClient::new(channel).check(check)).await.unwrap().map(drop)
}

/// A client that has nothing of the process: it trusts `authority` and shows `shown`.
async fn stranger(endpoint: &Endpoint, authority: &Authority, shown: &Signed) -> Result<(), Status> {
    let tls = ClientTlsConfig::new().domain_name("localhost").ca_certificate(Certificate::from_pem(authority.0.pem()));
    let tls = tls.identity(tonic::transport::Identity::from_pem(&shown.pem, &shown.key));
    ask(Traced::new(Channel::from_shared(endpoint.to_string()).unwrap().tls_config(tls).unwrap().connect_lazy())).await
}

/// The certificate that is shown to who connects now.
async fn shown_by(endpoint: &Endpoint, authority: &Authority) -> Vec<u8> {
    use tokio_rustls::rustls::crypto::ring::default_provider;
    use tokio_rustls::rustls::{ClientConfig, RootCertStore};
    let Endpoint::Tls { host, port } = endpoint else { panic!("{endpoint}") };
    let mut roots = RootCertStore::empty();
    roots.add(authority.0.der().clone()).unwrap();
    let config = ClientConfig::builder_with_provider(Arc::new(default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    let stream = tokio::net::TcpStream::connect((host.as_str(), *port)).await.unwrap();
    let connector = tokio_rustls::TlsConnector::from(Arc::new(config));
    let stream = connector.connect("localhost".try_into().unwrap(), stream).await.unwrap();
    stream.get_ref().1.peer_certificates().unwrap()[0].to_vec()
}

fn refused(server: &LiveServerTls, client: &ClientTls, file: &Path) {
    let error = read_again(Some(server), client).unwrap_err();
    assert_eq!(error.file, file, "{error}");
}

#[tokio::test]
async fn a_connection_made_after_certificates_were_read_again_is_with_the_new_ones_and_bad_ones_change_nothing() {
    let (files, authority) = (Files(tempfile::tempdir().unwrap()), Authority::new());
    let (first, second) = (authority.sign(), authority.sign());
    files.write(&authority, &first);
    let (ca, cert, key) = (files.path("ca"), files.path("cert"), files.path("key"));
    let (tls, server) = (files.client(), files.server());
    let exposure = Exposure { tls: Some(server.clone()), ..Exposure::default() };
    let bound = bind_as(&"localhost:0".parse().unwrap(), &exposure).await.unwrap();
    let endpoint = bound.endpoint().clone();
    let gate = Arc::new(Remembering::default());
    let caller = || gate.0.lock().unwrap().clone().unwrap();
    let (serving, shutdown) = (Serving { gate: gate.clone(), ..Serving::default() }, CancellationToken::new());
    let served = tokio::spawn(bound.serve_as(Services::new(), serving, shutdown.clone()));

    let (open, lazy) = (connect(&endpoint, &tls).await.unwrap(), connect_lazily(&endpoint, &tls).unwrap());
    ask(open.clone()).await.unwrap();
    assert_eq!((caller(), shown_by(&endpoint, &authority).await), (first.der.clone(), first.der.clone()));

    // The next connection of both sides is with the new ones, also that of a channel from before; an open one goes on.
    files.write(&authority, &second);
    let renewed = read_again(Some(&server), &tls).unwrap();
    assert_eq!(shown_by(&endpoint, &authority).await, first.der, "not before it is taken over");
    renewed.take_over();
    assert_eq!(shown_by(&endpoint, &authority).await, second.der);
    ask(lazy).await.unwrap();
    assert_eq!(caller(), second.der);
    ask(open.clone()).await.unwrap();
    assert_eq!(caller(), first.der);

    // Bad ones: the old stay, of the server and of its clients.
    std::fs::write(&key, &first.key).unwrap();
    refused(&server, &tls, &key);
    std::fs::write(&cert, "no certificate").unwrap();
    refused(&server, &tls, &cert);
    files.write(&authority, &first);
    std::fs::write(&ca, "").unwrap();
    refused(&server, &tls, &ca);
    std::fs::remove_file(&ca).unwrap();
    refused(&server, &tls, &ca);
    assert_eq!(shown_by(&endpoint, &authority).await, second.der);
    ask(connect(&endpoint, &tls).await.unwrap()).await.unwrap();
    assert_eq!(caller(), second.der);

    // Another authority: who has a certificate of the old one is not let in any more.
    let other = Authority::new();
    let third = other.sign();
    stranger(&endpoint, &authority, &first).await.unwrap();
    files.write(&other, &third);
    read_again(Some(&server), &tls).unwrap().take_over();
    stranger(&endpoint, &other, &first).await.unwrap_err();
    stranger(&endpoint, &other, &third).await.unwrap();
    ask(connect(&endpoint, &tls).await.unwrap()).await.unwrap();
    assert_eq!(caller(), third.der);

    shutdown.cancel();
    tokio::time::timeout(LONG, served).await.unwrap().unwrap().unwrap();
}

/// A system of its own: an authority, a server of it, and a client of it.
struct System {
    authority: Authority,
    files: Files,
    endpoint: Endpoint,
    tls: ClientTls,
    _shutdown: DropGuard,
}

impl System {
    async fn start() -> System {
        let (files, authority) = (Files(tempfile::tempdir().unwrap()), Authority::new());
        files.write(&authority, &authority.sign());
        let exposure = Exposure { tls: Some(files.server()), ..Exposure::default() };
        let bound = bind_as(&"localhost:0".parse().unwrap(), &exposure).await.unwrap();
        let endpoint = bound.endpoint().clone();
        let gate = Arc::new(Remembering::default());
        let (serving, shutdown) = (Serving { gate, ..Serving::default() }, CancellationToken::new());
        tokio::spawn(bound.serve_as(Services::new(), serving, shutdown.clone()));
        let tls = files.client();
        System { authority, files, endpoint, tls, _shutdown: shutdown.drop_guard() }
    }

    /// What a client with `tls` hears here, over each way to connect.
    async fn asked_by(&self, tls: &ClientTls) -> Vec<bool> {
        let several = Endpoint::AnyOf(vec![self.endpoint.clone(), "unix:/nobody".parse().unwrap()]);
        let leader = Channels::new(tls).get(&several).unwrap();
        let health = Health::of(self.endpoint.clone(), tls).is_serving(LONG).await;
        vec![
            ask(Channels::new(tls).get(&self.endpoint).unwrap()).await.is_ok(),
            connect(&self.endpoint, tls).await.is_ok(),
            health == Ok(true),
            ask(leader).await.is_ok(),
        ]
    }
}

#[tokio::test]
async fn two_clients_of_one_process_each_reach_the_server_of_their_own_authority_and_are_refused_by_the_other() {
    let (one, other) = (System::start().await, System::start().await);
    let (reached, refused) = (vec![true; 4], vec![false; 4]);
    assert_eq!((one.asked_by(&one.tls).await, other.asked_by(&other.tls).await), (reached.clone(), reached.clone()));
    assert_eq!((one.asked_by(&other.tls).await, other.asked_by(&one.tls).await), (refused.clone(), refused.clone()));

    // The one client changes to the other system. Everything that was made with its handle does; the other client is as it was.
    let before = Channels::new(&one.tls);
    let lazy = before.get(&other.endpoint).unwrap();
    one.files.write(&other.authority, &other.authority.sign());
    read_again(None, &one.tls).unwrap().take_over();
    ask(lazy).await.unwrap();
    assert_eq!((one.asked_by(&one.tls).await, other.asked_by(&one.tls).await), (refused.clone(), reached.clone()));
    assert_eq!((one.asked_by(&other.tls).await, other.asked_by(&other.tls).await), (refused, reached));
}

#[tokio::test]
async fn a_client_without_an_authority_is_refused_with_what_to_set() {
    let system = System::start().await;
    let refused = ask(Channels::new(&ClientTls::none()).get(&system.endpoint).unwrap()).await.unwrap_err();
    let mut said = String::new();
    let mut source: Option<&dyn std::error::Error> = Some(&refused);
    while let Some(error) = source {
        said += &error.to_string();
        source = error.source();
    }
    assert!(said.contains("`localhost` serves with TLS") && said.contains("RATN_TLS_CA"), "{said}");
}
