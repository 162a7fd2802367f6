//! Every server of a system inside a test, and calls of any method of them with any message.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, reason = "a test may panic, and uses what it needs")]

use prost_reflect::DescriptorPool;
use ratn_daemon::access::{AccessConfig, LiveAccess, Role, UserAccess};
use ratn_daemon::metrics::Metrics;
use ratn_daemon::service::ServiceConfig;
use ratn_daemon::{process_manager, resource_manager, world_pool};
use ratn_worker::client::Channels;
use ratn_worker::endpoint::Endpoint;
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::safety::Safety;
use ratn_worker::server::{Services, bind};
use ratn_worker::tls::ClientTls;
use ratn_worker::trace::Traced;
use ratn_worker::worker::{Worker, WorkerOptions};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::codegen::http::uri::PathAndQuery;
use tonic::{Code, Request, Status};

/// Starting takes at most this long.
const DEADLINE: Duration = Duration::from_secs(60);
/// A refusal waits for nothing; what says nothing for this long was let in.
const PATIENCE: Duration = Duration::from_secs(2);

pub const ROLES: [&[Role]; 5] = [&[], &[Role::Viewer], &[Role::Task], &[Role::Agent], &[Role::Operator]];

/// By service, its methods with what their option says.
pub fn methods() -> BTreeMap<String, Vec<(String, Option<String>)>> {
    let pool = DescriptorPool::decode(ratn_proto::FILE_DESCRIPTOR_SET).unwrap();
    let option = pool.get_extension_by_name("ratn.v1.access").unwrap();
    let values = option.kind().as_enum().unwrap().clone();
    let access = |method: prost_reflect::MethodDescriptor| {
        let options = method.options();
        let said = options.has_extension(&option).then(|| options.get_extension(&option).as_enum_number().unwrap());
        (method.name().to_owned(), said.map(|number| values.get_value(number).unwrap().name().to_owned()))
    };
    let of = |service: prost_reflect::ServiceDescriptor| {
        (service.full_name().to_owned(), service.methods().map(access).collect())
    };
    pool.services().filter(|service| service.full_name().starts_with("ratn.")).map(of).collect()
}

/// Messages as they are.
#[derive(Default)]
struct Plain;

impl Codec for Plain {
    type Encode = Vec<u8>;
    type Decode = ();
    type Encoder = Plain;
    type Decoder = Plain;

    fn encoder(&mut self) -> Plain {
        Plain
    }

    fn decoder(&mut self) -> Plain {
        Plain
    }
}

impl Encoder for Plain {
    type Item = Vec<u8>;
    type Error = Status;

    fn encode(&mut self, message: Vec<u8>, buffer: &mut EncodeBuf<'_>) -> Result<(), Status> {
        bytes::BufMut::put_slice(buffer, &message);
        Ok(())
    }
}

impl Decoder for Plain {
    type Item = ();
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> Result<Option<()>, Status> {
        let left = bytes::Buf::remaining(buffer);
        bytes::Buf::advance(buffer, left);
        Ok(Some(()))
    }
}

/// How a call with one message is answered; `None` where it is not, for now.
pub async fn call(channel: &Traced, path: &str, message: Vec<u8>) -> Option<Result<(), Status>> {
    let called = async {
        let mut client = tonic::client::Grpc::new(channel.clone());
        client.ready().await.unwrap();
        let path: PathAndQuery = path.parse().unwrap();
        let mut answers = client.streaming(Request::new(tokio_stream::once(message)), path, Plain).await?.into_inner();
        answers.message().await.map(drop)
    };
    tokio::time::timeout(PATIENCE, called).await.ok()
}

pub fn only(roles: &[Role]) -> AccessConfig {
    let user = UserAccess { uid: nix::unistd::geteuid().as_raw(), roles: roles.to_vec() };
    AccessConfig { users: vec![user], ..AccessConfig::default() }
}

/// A server: in which role which channel is to be used.
pub struct Server {
    pub name: &'static str,
    pub channels: Vec<Traced>,
}

/// The four daemons, of which who calls changes with `access`, and a driver for each role, made as drivers are.
pub async fn servers(place: &Path, access: &LiveAccess, end: &CancellationToken) -> Vec<Server> {
    let directory = RuntimeDirectory::create(place.join("run")).unwrap();
    let (service, metrics) = (ServiceConfig::default(), Arc::new(Metrics::new(resource_manager::ROLE)));
    let manager = resource_manager::run_as(
        tokio::sync::watch::Sender::new(resource_manager::ResourceManagerConfig::default()).subscribe(),
        directory.clone(),
        service.serving_with(access, &metrics),
        metrics.clone(),
        end.clone(),
    );
    tokio::spawn(manager);
    directory.wait_for(resource_manager::ROLE, DEADLINE).await.unwrap();
    let (to, serving) = (directory.clone(), || service.serving_with(access, &metrics));
    let (config, counted) = (world_pool::WorldPoolConfig::default(), Arc::new(Metrics::new(world_pool::ROLE)));
    tokio::spawn(world_pool::run_as(config, to.clone(), serving(), counted, ClientTls::none(), end.clone()));
    let config = process_manager::ProcessManagerConfig::default();
    tokio::spawn(process_manager::run_as(config, to.clone(), serving(), ClientTls::none(), end.clone()));
    tokio::spawn(ratn_cell::run_as(
        ratn_cell::config::CellConfig::default(),
        to,
        serving(),
        ClientTls::none(),
        end.clone(),
    ));
    let run = directory.socket(ratn_task_control::control::ROLE);
    let services = Services::new().with(ratn_task_control::control::RunServer::of_nobody().into_service());
    tokio::spawn(bind(&run).await.unwrap().serve_as(services, serving(), end.clone()));
    let channels = Channels::new(&ClientTls::none());
    let mut servers = Vec::new();
    for name in [resource_manager::ROLE, world_pool::ROLE, process_manager::ROLE, ratn_cell::ROLE] {
        let endpoint = directory.wait_for(name, DEADLINE).await.unwrap();
        servers.push(Server { name, channels: vec![channels.get(&endpoint).unwrap(); ROLES.len()] });
    }
    servers.push(Server { name: "run", channels: vec![channels.get(&run).unwrap(); ROLES.len()] });
    let mut drivers = Server { name: "driver", channels: Vec::new() };
    for (i, roles) in ROLES.iter().enumerate() {
        let (file, listen) = (place.join(format!("{i}.toml")), Endpoint::Unix(place.join(format!("{i}.sock"))));
        let words = roles.iter().map(|role| format!("{role:?}").to_lowercase()).collect::<Vec<_>>();
        let uid = nix::unistd::geteuid();
        std::fs::write(&file, format!("[[service.access.user]]\nuid = {uid}\nroles = {words:?}\n")).unwrap();
        let id = "driver".to_owned();
        let options = WorkerOptions { id, listen: listen.clone(), access: Some(file), ..WorkerOptions::default() };
        // Roles are what is asked for here.
        let driver = Worker::new(options).dangerously_believe_every_lease();
        tokio::spawn(driver.safety(Safety::default()).shutdown(end.clone()).run());
        let channel = channels.get(&listen).unwrap();
        let asked = async {
            while call(&channel, "/grpc.health.v1.Health/Check", Vec::new())
                .await
                .is_none_or(|answer| answer.is_err_and(|status| status.code() == Code::Unavailable))
            {
                tokio::task::yield_now().await;
            }
        };
        tokio::time::timeout(DEADLINE, asked).await.unwrap();
        drivers.channels.push(channel);
    }
    servers.push(drivers);
    servers
}

/// Whether a server has a service, as its health says.
pub async fn serves(channel: &Traced, service: &str) -> bool {
    let mut question = vec![0x0a, u8::try_from(service.len()).unwrap()];
    question.extend(service.as_bytes());
    match call(channel, "/grpc.health.v1.Health/Check", question).await.unwrap() {
        Ok(()) => true,
        Err(status) => {
            assert_eq!(status.code(), Code::NotFound, "{service}: {status}");
            false
        }
    }
}
