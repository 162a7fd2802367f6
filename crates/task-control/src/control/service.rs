//! The gRPC service of the runs: signals, answers and breakpoints from clients of any language, and what the states wait for.
//!
//! It answers the same as the sockets of [`super`], to which it forwards. One of the runs serves it for all of them, at the Unix socket `run.sock` of
//! the runtime directory, with the endpoint file `run.endpoint`; when that run ends, the next one takes over. Access is checked by the default table
//! of roles, for processes without a config.

use super::{ANY_RUN, Asked, Awaiting, Message, RunStatus, find, is_nobody, is_uncertain, send};
use futures::FutureExt;
use ratn_executive::protocol::Awaited;
use ratn_model::value::Value;
use ratn_proto::convert::label;
use ratn_proto::v1;
use ratn_proto::v1::run_service_server::{RunService, RunServiceServer};
use ratn_worker::access::Caller;
use ratn_worker::audit::{self, Mutation};
use ratn_worker::runtime_directory::RuntimeDirectory;
use ratn_worker::server::{ServeError, Services, bind};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status};

/// The role name of the service in the runtime directory.
pub const ROLE: &str = "run";

/// Interval at which a run tries to take over the service.
const TURN: Duration = Duration::from_millis(200);

/// Serves the [`RunService`] of the runs in a directory.
#[derive(Debug, Clone)]
pub struct RunServer {
    directory: PathBuf,
    /// The socket of the run in this process.
    socket: PathBuf,
    tell: mpsc::Sender<Asked>,
}

impl RunServer {
    /// Serves no run: every admitted call is refused. For tests of access control.
    pub fn of_nobody() -> RunServer {
        RunServer { directory: PathBuf::new(), socket: PathBuf::new(), tell: mpsc::channel(1).0 }
    }

    pub(super) fn of(directory: &Path, run: &str, tell: mpsc::Sender<Asked>) -> RunServer {
        RunServer { directory: directory.to_owned(), socket: find::socket(directory, run), tell }
    }

    /// The gRPC service, for [`Services::with`].
    pub fn into_service(self) -> RunServiceServer<RunServer> {
        RunServiceServer::new(self)
    }

    /// Serves in a runtime directory until `end`, as soon as no other run does.
    pub(super) async fn serve(self, directory: &Path, end: CancellationToken) -> Result<(), ServeProblem> {
        let directory = RuntimeDirectory::at(directory);
        let bound = loop {
            match bind(&directory.socket(ROLE)).await {
                Err(error) if !error.is_taken() => return Err(error.into()),
                Ok(bound) => break bound,
                Err(_) => {
                    if end.run_until_cancelled(tokio::time::sleep(TURN)).await.is_none() {
                        return Ok(());
                    }
                }
            }
        };
        let _published = directory.publish(ROLE, bound.endpoint())?;
        Ok(bound.serve(Services::new().with(self.into_service()), end).boxed().await?)
    }

    /// Whether a run is the one in this process.
    async fn is_own(&self, run: &str) -> Result<bool, Status> {
        match find::meant(&self.directory, run).await {
            Ok(socket) => Ok(socket == self.socket),
            Err(error) if is_nobody(&error) => Err(has_ended()),
            Err(error) => Err(Status::failed_precondition(error.to_string())),
        }
    }

    async fn say(&self, message: Message) -> Result<String, Status> {
        if self.is_own(message.run()).await? {
            let (say, said) = oneshot::channel();
            self.ask(Asked::Message(message, say))?;
            return said.await.map_err(|_| has_ended())?.map_err(Status::failed_precondition);
        }
        send(&self.directory, &message).await.map_err(|error| match error {
            error if is_nobody(&error) => has_ended(),
            error if is_uncertain(&error) => Status::unknown(error.to_string()),
            error => Status::failed_precondition(error.to_string()),
        })
    }

    async fn status(&self, run: &str) -> Result<RunStatus, Status> {
        if self.is_own(run).await? {
            let (say, said) = oneshot::channel();
            self.ask(Asked::Status(say))?;
            return said.await.map_err(|_| has_ended());
        }
        let status = find::status(&self.directory, run).await;
        status.map_err(|error| Status::unavailable(error.to_string()))?.ok_or_else(has_ended)
    }

    fn ask(&self, asked: Asked) -> Result<(), Status> {
        self.tell.try_send(asked).map_err(|error| match error {
            mpsc::error::TrySendError::Full(_) => Status::resource_exhausted("the run is too far behind"),
            mpsc::error::TrySendError::Closed(_) => has_ended(),
        })
    }
}

/// Why the service cannot be served.
#[derive(Debug, thiserror::Error)]
pub(super) enum ServeProblem {
    #[error(transparent)]
    Bind(#[from] ratn_worker::server::BindError),
    #[error("its endpoint file cannot be written: {0}")]
    Publish(#[from] std::io::Error),
    #[error(transparent)]
    Serve(#[from] ServeError),
}

fn has_ended() -> Status {
    Status::unavailable("the run has just ended")
}

#[tonic::async_trait]
impl RunService for RunServer {
    async fn get_waits(&self, request: Request<v1::GetWaitsRequest>) -> Result<Response<v1::GetWaitsResponse>, Status> {
        let wanted = named(request.into_inner().run);
        label(&wanted, "run")?;
        let RunStatus { run, task, awaits, .. } = self.status(&wanted).await?;
        let waits = awaits.into_iter().map(v1::Wait::from).collect();
        Ok(Response::new(v1::GetWaitsResponse { run, task, waits }))
    }

    async fn send_signal(
        &self,
        request: Request<v1::SendSignalRequest>,
    ) -> Result<Response<v1::SendSignalResponse>, Status> {
        let caller = Caller::of(&request);
        let v1::SendSignalRequest { run, signal, value } = request.into_inner();
        let value = match value {
            Some(value) => Value::try_from(value)?,
            None => Value::Null,
        };
        let message = Message::Signal { run: named(run), signal: signal.clone(), value }.checked()?;
        let pending = audit::begin(&caller, "", || Mutation::Signal { signal });
        let said = self.say(message).await;
        pending.ended(&said);
        Ok(Response::new(v1::SendSignalResponse { said: said? }))
    }

    async fn send_answer(
        &self,
        request: Request<v1::SendAnswerRequest>,
    ) -> Result<Response<v1::SendAnswerResponse>, Status> {
        let caller = Caller::of(&request);
        let v1::SendAnswerRequest { run, state, choice } = request.into_inner();
        let asking = Some(state.clone()).filter(|state| !state.is_empty());
        let message = Message::Answer { run: named(run), state: asking, choice: choice.clone() }.checked()?;
        let pending = audit::begin(&caller, "", || Mutation::Answer { state, choice });
        let said = self.say(message).await;
        pending.ended(&said);
        Ok(Response::new(v1::SendAnswerResponse { said: said? }))
    }

    async fn get_breakpoints(
        &self,
        request: Request<v1::GetBreakpointsRequest>,
    ) -> Result<Response<v1::GetBreakpointsResponse>, Status> {
        let wanted = named(request.into_inner().run);
        label(&wanted, "run")?;
        let RunStatus { run, task, paused, breakpoints, .. } = self.status(&wanted).await?;
        Ok(Response::new(v1::GetBreakpointsResponse { run, task, states: breakpoints, paused }))
    }

    async fn set_breakpoint(
        &self,
        request: Request<v1::SetBreakpointRequest>,
    ) -> Result<Response<v1::SetBreakpointResponse>, Status> {
        let caller = Caller::of(&request);
        let v1::SetBreakpointRequest { run, state } = request.into_inner();
        if state.is_empty() {
            return Err(Status::invalid_argument("`state` is empty: say before which state the run shall pause"));
        }
        let message = Message::Breakpoint { run: named(run), state: Some(state.clone()), set: true }.checked()?;
        let pending = audit::begin(&caller, "", || Mutation::SetBreakpoint { state });
        let said = self.say(message).await;
        pending.ended(&said);
        Ok(Response::new(v1::SetBreakpointResponse { said: said? }))
    }

    async fn clear_breakpoint(
        &self,
        request: Request<v1::ClearBreakpointRequest>,
    ) -> Result<Response<v1::ClearBreakpointResponse>, Status> {
        let caller = Caller::of(&request);
        let v1::ClearBreakpointRequest { run, state } = request.into_inner();
        let meant = Some(state.clone()).filter(|state| !state.is_empty());
        let message = Message::Breakpoint { run: named(run), state: meant, set: false }.checked()?;
        let pending = audit::begin(&caller, "", || Mutation::ClearBreakpoint { state });
        let said = self.say(message).await;
        pending.ended(&said);
        Ok(Response::new(v1::ClearBreakpointResponse { said: said? }))
    }
}

fn named(run: String) -> String {
    if run.is_empty() { ANY_RUN.to_owned() } else { run }
}

impl From<Awaiting> for v1::Wait {
    fn from(awaiting: Awaiting) -> v1::Wait {
        use v1::wait::Awaited as Wire;
        let Awaiting { path, awaited, until_s } = awaiting;
        let awaited = match awaited {
            Awaited::Time => None,
            Awaited::Condition { condition } => Some(Wire::Condition(condition)),
            Awaited::Signal { signal } => Some(Wire::Signal(signal)),
            Awaited::Answer { question, choices, default } => {
                Some(Wire::Question(v1::Question { text: question, choices, default }))
            }
        };
        v1::Wait { path, until_s, awaited }
    }
}
