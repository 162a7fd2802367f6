//! The HTTP server for the pages and their requests. Limited: few connections, small requests, and a client that does not read is cut off.

use crate::annotations::{self, Editing, MAX_BODY, Problem, Proposal};
use crate::gate::{self, HEADERS, Refused, Token};
use crate::logs::{Asked, Logs, MAX_LOGS, NotTold, absolute};
use crate::patience::Patient;
use crate::robot::{self, Robots};
use crate::system::{Heard, System};
use crate::{task, wire};
use http_body_util::Full;
use hyper::body::{Body, Bytes, Incoming};
use hyper::header::{ALLOW, CONTENT_TYPE, HeaderValue};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{HeaderMap, Method, Request, Response, StatusCode, Uri};
use hyper_util::rt::{TokioIo, TokioTimer};
use ratn_event_log::LogError;
use ratn_model::id::InstanceId;
use ratn_model::program::Program;
use ratn_model::value::Value;
use ratn_proto::types::Scale;
use ratn_task_control::control::{self, Message, Word};
use ratn_worker::tls::ClientTls;
use serde::Serialize;
use std::collections::{BTreeMap, VecDeque};
use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::task::AbortHandle;

/// Maximum number of connections at once; a browser has six. For a further one, the oldest connection without the token is closed; if there
/// is none, the further one itself.
const MAX_CONNECTIONS: usize = 96;
/// Maximum size of a request's head, in bytes …
const MAX_REQUEST_BYTES: usize = 16 * 1024;
/// … maximum number of its headers …
const MAX_HEADERS: usize = 64;
/// … and default time limit until it is complete. A client that accepts nothing of an answer for this long is cut off.
const PATIENCE: Duration = Duration::from_secs(10);
/// Pause after a failed accept: the process has no free file descriptors.
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);
/// Maximum number of folds that are read at once.
const MAX_READING: usize = 4;
/// Maximum number of robots cached; beyond it all are read again.
const MOST_ROBOTS: usize = 16;
/// Pause before a robot that could not be read is tried again.
const ROBOT_AGAIN: Duration = Duration::from_secs(3);
const JSON: &str = "application/json";
const BYTES: &str = "application/octet-stream";

/// The pages, as `scripts/build-dashboard` builds them from `web/`.
const PAGES: [(&str, &str, &str); 5] = [
    ("/", "text/html; charset=utf-8", include_str!("../assets/index.html")),
    ("/app.js", "text/javascript; charset=utf-8", include_str!("../assets/app.js")),
    // Loaded only by the page that needs it.
    ("/cell.js", "text/javascript; charset=utf-8", include_str!("../assets/cell.js")),
    ("/app.css", "text/css; charset=utf-8", include_str!("../assets/app.css")),
    ("/icon.svg", "image/svg+xml", include_str!("../assets/icon.svg")),
];

/// Loads the task file of a log. A file that is not the task of the run is not shown.
#[derive(Clone)]
pub struct Tasks(Arc<Load>);

type Load = dyn Fn(&Path) -> Result<Program, String> + Send + Sync;

impl Tasks {
    /// With this function; an error is a sentence that says why a task is missing.
    pub fn by(load: impl Fn(&Path) -> Result<Program, String> + Send + Sync + 'static) -> Tasks {
        Tasks(Arc::new(load))
    }

    /// Loads no tasks.
    pub fn none() -> Tasks {
        Tasks::by(|_| Err("task files are not read here".to_owned()))
    }
}

impl std::fmt::Debug for Tasks {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Tasks(…)")
    }
}

/// What the dashboard shows, and where.
#[derive(Debug, Clone)]
pub struct Options {
    /// The address of the pages: a loopback address. Port 0 takes a free one.
    pub address: SocketAddr,
    /// Event logs, at most [`MAX_LOGS`]. The log of a run under way in `directory` is added.
    pub logs: Vec<PathBuf>,
    /// The runtime directory of a system.
    pub directory: PathBuf,
    /// Whether pages may pause, step, continue and end a run.
    pub control: bool,
    /// The task file whose annotations pages may change.
    pub edit: Option<Editing>,
    /// TLS settings of the clients of the system.
    pub tls: ClientTls,
    /// Loads tasks.
    pub tasks: Tasks,
    /// Loads the robot of a log.
    pub robots: Robots,
    /// A browser that sends or accepts nothing for this long is cut off.
    pub patience: Duration,
}

impl Options {
    /// Options for a system's runtime directory, at a free port, without logs, read-only.
    pub fn of(directory: PathBuf, tls: ClientTls) -> Options {
        let address = SocketAddr::from(([127, 0, 0, 1], 0));
        Options {
            address,
            logs: Vec::new(),
            directory,
            control: false,
            edit: None,
            tls,
            tasks: Tasks::none(),
            robots: Robots::none(),
            patience: PATIENCE,
        }
    }
}

/// Why the dashboard cannot be served.
#[derive(Debug, thiserror::Error)]
pub enum DashboardError {
    /// Other machines could reach the address.
    #[error(
        "the dashboard is for this machine alone, and {address} is not a loopback address: from another machine use `ssh -L`"
    )]
    Exposed {
        /// The address.
        address: SocketAddr,
    },
    /// Too many logs were named.
    #[error("{given} logs are more than the {MAX_LOGS} that are looked at at once: name fewer")]
    TooMany {
        /// Number of logs named.
        given: usize,
    },
    /// A log cannot be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// A log does not exist.
    #[error("cannot read the event log {}", path.display())]
    NoLog {
        /// The log.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// The address is not available.
    #[error("cannot serve pages at {address}")]
    Refused {
        /// The address.
        address: SocketAddr,
        /// The cause.
        source: io::Error,
    },
    /// The system provides no random bytes for a token.
    #[error("the system gives no random bytes for a token")]
    NoToken,
}

/// A server that is bound to its address and does not serve yet.
#[derive(Debug)]
pub struct Dashboard {
    listener: TcpListener,
    address: SocketAddr,
    shown: Arc<Shown>,
    patience: Duration,
}

/// The content shown to clients with the token.
#[derive(Debug)]
struct Shown {
    token: Token,
    logs: Arc<Logs>,
    system: System,
    control: bool,
    edit: Option<Editing>,
    tasks: Tasks,
    robots: Arc<KnownRobots>,
    reading: Semaphore,
}

/// The robots of the logs: each is read when it is first asked for, and cached.
#[derive(Debug)]
struct KnownRobots {
    robots: Robots,
    /// By the robot's name or path in the log.
    shown: Mutex<BTreeMap<String, (Instant, Loaded)>>,
}

type Loaded = Result<Arc<robot::Shown>, String>;

impl KnownRobots {
    /// The robot of a log that names it so. May read files.
    fn get(&self, of_log: &str) -> Loaded {
        // A panic leaves the map intact.
        let mut shown = self.shown.lock().unwrap_or_else(PoisonError::into_inner);
        match shown.get(of_log) {
            Some((at, loaded)) if loaded.is_ok() || at.elapsed() < ROBOT_AGAIN => return loaded.clone(),
            _ => {}
        }
        let loaded = self.robots.load(of_log).map(Arc::new);
        if shown.len() >= MOST_ROBOTS {
            shown.clear();
        }
        shown.insert(of_log.to_owned(), (Instant::now(), loaded.clone()));
        loaded
    }
}

/// The head of a request.
struct Head {
    method: Method,
    uri: Uri,
    headers: HeaderMap,
}

/// A command to a run.
enum Told {
    /// A command word, and its meaning.
    Word(Word, &'static str),
    /// An answer to the question of a state.
    Answer { state: String, choice: String },
    /// A signal of this name, without a value.
    Signal(String),
    /// A breakpoint at a state, or all breakpoints if no state is given.
    Breakpoint { state: Option<String>, set: bool },
}

/// An answer to a page.
enum Answer {
    Json(String),
    Bytes(Bytes),
    Refused(StatusCode, String),
}

impl Dashboard {
    /// Binds the address, and checks that the logs can be read.
    ///
    /// # Errors
    /// [`DashboardError`].
    pub async fn bind(options: Options) -> Result<Dashboard, DashboardError> {
        let Options { address, logs, directory, control, edit, tls, tasks, robots, patience } = options;
        if !address.ip().is_loopback() {
            return Err(DashboardError::Exposed { address });
        }
        if logs.len() > MAX_LOGS {
            return Err(DashboardError::TooMany { given: logs.len() });
        }
        let mut paths: Vec<PathBuf> = Vec::new();
        for path in &logs {
            let path = absolute(path).map_err(|source| DashboardError::NoLog { path: path.clone(), source })?;
            ratn_event_log::first(&path)?;
            if !paths.contains(&path) {
                paths.push(path);
            }
        }
        let token = Token::random().ok_or(DashboardError::NoToken)?;
        let refused = |source| DashboardError::Refused { address, source };
        let listener = TcpListener::bind(address).await.map_err(refused)?;
        let address = listener.local_addr().map_err(refused)?;
        let (logs, system) = (Arc::new(Logs::of(&paths)), System::of(directory, &tls));
        let reading = Semaphore::new(MAX_READING);
        let robots = Arc::new(KnownRobots { robots, shown: Mutex::default() });
        let shown = Arc::new(Shown { token, logs, system, control, edit, tasks, robots, reading });
        Ok(Dashboard { listener, address, shown, patience })
    }

    /// The URL that its user opens. The token is in the fragment after `#`, which browsers do not send.
    pub fn url(&self) -> String {
        format!("http://{}/#token={}", self.address, self.shown.token.text())
    }

    /// Serves for as long as the future is polled.
    pub async fn serve(self) {
        let mut open: VecDeque<Open> = VecDeque::new();
        loop {
            let Ok((connection, _)) = self.listener.accept().await else {
                tokio::time::sleep(ACCEPT_AGAIN).await;
                continue;
            };
            open.retain(|one| !one.task.is_finished());
            if open.len() >= MAX_CONNECTIONS {
                let strange = open.iter().position(|one| !one.has_shown_token.load(Ordering::Relaxed));
                let Some(oldest) = strange.and_then(|place| open.remove(place)) else { continue };
                oldest.task.abort();
            }
            let (shown, patience) = (self.shown.clone(), self.patience);
            let has_shown_token = Arc::new(AtomicBool::new(false));
            let mark = Arc::clone(&has_shown_token);
            let task = tokio::spawn(async move {
                // A client that left, or was too slow, gets no answer.
                let _ = answer(shown, connection, patience, mark).await;
            });
            open.push_back(Open { has_shown_token, task: task.abort_handle() });
        }
    }
}

/// An open connection.
struct Open {
    has_shown_token: Arc<AtomicBool>,
    task: AbortHandle,
}

async fn answer(
    shown: Arc<Shown>,
    connection: TcpStream,
    patience: Duration,
    has_shown_token: Arc<AtomicBool>,
) -> hyper::Result<()> {
    let page = service_fn(move |request: Request<Incoming>| {
        let (shown, has_shown_token) = (shown.clone(), has_shown_token.clone());
        async move {
            let head = Head {
                method: request.method().clone(),
                uri: request.uri().clone(),
                headers: request.headers().clone(),
            };
            let may_look = gate::may_look(&head.headers, &shown.token).is_ok();
            if may_look {
                has_shown_token.store(true, Ordering::Relaxed);
            }
            // Other requests have no body.
            let has_body =
                may_look && shown.edit.is_some() && head.method == Method::POST && is_change(head.uri.path());
            let body = match has_body {
                true => match tokio::time::timeout(patience, body(request.into_body())).await {
                    Ok(Some(body)) => body,
                    Ok(None) => return Ok(refusal(StatusCode::PAYLOAD_TOO_LARGE, TOO_LARGE)),
                    Err(_) => return Ok(refusal(StatusCode::REQUEST_TIMEOUT, "the body of the question did not come")),
                },
                false => Vec::new(),
            };
            Ok::<_, Infallible>(shown.answer(&head, &body).await)
        }
    });
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(patience)
        .max_buf_size(MAX_REQUEST_BYTES)
        .max_headers(MAX_HEADERS)
        .serve_connection(TokioIo::new(Patient::new(connection, patience)), page)
        .await
}

/// Maximum number of bytes read and discarded of a body that is too long.
const MAX_FORGOTTEN: usize = 16 * MAX_BODY;
const TOO_LARGE: &str = "a change has at most 64 KiB";

/// Whether a request carries a change in its body.
fn is_change(path: &str) -> bool {
    matches!(path, "/api/annotations/check" | "/api/annotations/gain" | "/api/annotations/save")
}

/// Reads a body of at most [`MAX_BODY`] bytes. Of a longer one some more is read and discarded: a client that still writes would not read
/// the refusal.
async fn body(mut incoming: Incoming) -> Option<Vec<u8>> {
    let (mut bytes, mut length) = (Vec::new(), 0);
    while let Some(frame) = std::future::poll_fn(|context| Pin::new(&mut incoming).poll_frame(context)).await {
        let Ok(data) = frame.ok()?.into_data() else { continue };
        length += data.len();
        if length <= MAX_BODY {
            bytes.extend_from_slice(&data);
        } else if length > MAX_FORGOTTEN {
            return None;
        }
    }
    (length <= MAX_BODY).then_some(bytes)
}

impl Shown {
    async fn answer(&self, head: &Head, body: &[u8]) -> Response<Full<Bytes>> {
        let path = head.uri.path();
        if let Some((_, kind, page)) = PAGES.iter().find(|(name, _, _)| *name == path) {
            return match (gate::asks_here(&head.headers), &head.method) {
                (Err(refused), _) => refusal(StatusCode::FORBIDDEN, &refused.to_string()),
                (Ok(_), &Method::GET) => response(StatusCode::OK, kind, *page),
                (Ok(_), _) => not_allowed("GET"),
            };
        }
        if let Err(refused) = gate::may_look(&head.headers, &self.token) {
            let status = if refused == Refused::Token { StatusCode::UNAUTHORIZED } else { StatusCode::FORBIDDEN };
            return refusal(status, &refused.to_string());
        }
        let query = Query::of(head.uri.query().unwrap_or_default());
        let answer = match (&head.method, path) {
            (&Method::GET, "/api/about") => self.about().await,
            (&Method::GET, "/api/run") => self.run(&query).await,
            (&Method::GET, "/api/task") => self.task(&query).await,
            (&Method::GET, "/api/world") => self.world(&query).await,
            (&Method::GET, "/api/robot") => self.robot(&query).await,
            (&Method::GET, "/api/mesh") => self.mesh(&query).await,
            (&Method::GET, "/api/cell") => self.cell(&query).await,
            (&Method::GET, "/api/system") => json(&self.system.told().await),
            (&Method::GET, "/api/tail") => self.tail(&query).await,
            (&Method::POST, "/api/control") => self.control(&query).await,
            (&Method::POST, "/api/scale") => self.scale(&query).await,
            (method, path)
                if let Some(edit) = &self.edit
                    && (path == "/api/annotations" || is_change(path)) =>
            {
                match (method, is_change(path)) {
                    (&Method::GET, false) => self.editing(edit, |edit| annotations::told(&edit)).await,
                    (&Method::POST, true) => self.change(edit, path, body).await,
                    (_, is_change) => return not_allowed(if is_change { "POST" } else { "GET" }),
                }
            }
            (_, "/api/control" | "/api/scale") => return not_allowed("POST"),
            (
                _,
                "/api/about" | "/api/run" | "/api/task" | "/api/world" | "/api/robot" | "/api/mesh" | "/api/cell"
                | "/api/system" | "/api/tail",
            ) => {
                return not_allowed("GET");
            }
            _ => Answer::Refused(StatusCode::NOT_FOUND, "there is nothing of this name".to_owned()),
        };
        match answer {
            Answer::Json(text) => response(StatusCode::OK, JSON, text),
            Answer::Bytes(bytes) => response(StatusCode::OK, BYTES, bytes),
            Answer::Refused(status, problem) => refusal(status, &problem),
        }
    }

    /// Asks the system for its runs, and adds their logs.
    async fn hear(&self) {
        if let Heard::Runs(statuses) = self.system.runs().await {
            self.logs.hear(statuses);
        }
    }

    async fn about(&self) -> Answer {
        self.hear().await;
        json(&wire::About {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            control: self.control,
            edit: self.edit.as_ref().map(Editing::name).unwrap_or_default(),
            directory: self.system.directory(),
            logs: self.logs.told(),
            problem: String::new(),
        })
    }

    async fn run(&self, query: &Query<'_>) -> Answer {
        let (id, asked) = match query.asked() {
            Ok(asked) => asked,
            Err(problem) => return Answer::Refused(StatusCode::BAD_REQUEST, problem),
        };
        if asked.at_s.is_none() {
            // Without an answer, the log is shown as far as it is written.
            self.hear().await;
        }
        let control = self.control;
        self.reading(move |logs| {
            let mut frame = logs.frame(id, &asked)?;
            frame.run.controllable = control && frame.run.live && frame.run.outcome.is_none();
            Ok(serde_json::to_string(&frame))
        })
        .await
    }

    async fn task(&self, query: &Query<'_>) -> Answer {
        let (id, _) = match query.asked() {
            Ok(asked) => asked,
            Err(problem) => return Answer::Refused(StatusCode::BAD_REQUEST, problem),
        };
        let tasks = self.tasks.clone();
        self.reading(move |logs| {
            let (file, digest) = logs.task(id)?;
            let told = match (tasks.0)(&file) {
                Ok(program) if program.digest == digest => task::told(&program),
                Ok(_) => task::unknown(format!("{} is not what it was when the run began", file.display())),
                Err(problem) => task::unknown(problem),
            };
            Ok(serde_json::to_string(&told))
        })
        .await
    }

    async fn world(&self, query: &Query<'_>) -> Answer {
        let (id, asked) = match query.asked() {
            Ok(asked) => asked,
            Err(problem) => return Answer::Refused(StatusCode::BAD_REQUEST, problem),
        };
        let filter = query.text("filter");
        self.reading(move |logs| Ok(serde_json::to_string(&logs.world(id, &asked, &filter)?))).await
    }

    async fn robot(&self, query: &Query<'_>) -> Answer {
        let id = match query.asked() {
            Ok((id, _)) => id,
            Err(problem) => return Answer::Refused(StatusCode::BAD_REQUEST, problem),
        };
        let robots = self.robots.clone();
        self.reading(move |logs| {
            let known = robots.get(&logs.robot(id)?);
            Ok(serde_json::to_string(&known.map_or_else(robot::unknown, |shown| shown.told())))
        })
        .await
    }

    /// The vertices of a mesh of a log's robot, by number, so that no request can name a file.
    async fn mesh(&self, query: &Query<'_>) -> Answer {
        let id = match query.asked() {
            Ok((id, _)) => id,
            Err(problem) => return Answer::Refused(StatusCode::BAD_REQUEST, problem),
        };
        let Some(number) = query.number("mesh").and_then(|number| usize::try_from(number).ok()) else {
            let problem = "say which mesh: `mesh=NUMBER`, as /api/robot lists them".to_owned();
            return Answer::Refused(StatusCode::BAD_REQUEST, problem);
        };
        let robots = self.robots.clone();
        self.looking(move |logs| {
            let known = robots.get(&logs.robot(id)?);
            Ok(match known.as_deref().map(|shown| shown.mesh(number)) {
                Ok(Some(bytes)) => Answer::Bytes(bytes),
                Ok(None) => Answer::Refused(StatusCode::NOT_FOUND, format!("the robot has no mesh {number}")),
                Err(problem) => Answer::Refused(StatusCode::NOT_FOUND, problem.clone()),
            })
        })
        .await
    }

    async fn cell(&self, query: &Query<'_>) -> Answer {
        let (id, asked) = match query.asked() {
            Ok(asked) => asked,
            Err(problem) => return Answer::Refused(StatusCode::BAD_REQUEST, problem),
        };
        // The true state of the cell is known only for the present.
        let truth = match asked.at_s.is_none() && self.logs.is_live(id) {
            true => self.system.truth().await,
            false => None,
        };
        let robots = self.robots.clone();
        self.reading(move |logs| {
            let known = robots.get(&logs.robot(id)?);
            let shown = known.as_deref().map_err(String::as_str);
            let cell = logs.cell(id, &asked, shown)?;
            Ok(serde_json::to_string(&wire::Cell { truth, ..cell }))
        })
        .await
    }

    /// Reads a log for an answer in JSON.
    async fn reading(
        &self,
        read: impl FnOnce(&Logs) -> Result<serde_json::Result<String>, NotTold> + Send + 'static,
    ) -> Answer {
        self.looking(move |logs| {
            Ok(match read(logs)? {
                Ok(text) => Answer::Json(text),
                Err(error) => Answer::Refused(StatusCode::INTERNAL_SERVER_ERROR, error.to_string()),
            })
        })
        .await
    }

    /// Reads logs in a blocking thread.
    async fn looking(&self, look: impl FnOnce(&Logs) -> Result<Answer, NotTold> + Send + 'static) -> Answer {
        let Ok(_place) = self.reading.acquire().await else {
            return Answer::Refused(StatusCode::SERVICE_UNAVAILABLE, "the dashboard ends".to_owned());
        };
        let logs = self.logs.clone();
        match tokio::task::spawn_blocking(move || look(&logs)).await {
            Ok(Ok(answer)) => answer,
            Ok(Err(error @ NotTold::Unknown(_))) => Answer::Refused(StatusCode::NOT_FOUND, error.to_string()),
            Ok(Err(error @ NotTold::Log(_))) => Answer::Refused(StatusCode::UNPROCESSABLE_ENTITY, chain(&error)),
            Err(_) => {
                Answer::Refused(StatusCode::INTERNAL_SERVER_ERROR, "reading the log ended with a panic".to_owned())
            }
        }
    }

    async fn tail(&self, query: &Query<'_>) -> Answer {
        let worker = query.text("worker");
        match self.system.tail(&worker).await {
            Ok(tail) => json(&tail),
            Err(problem) => Answer::Refused(StatusCode::NOT_FOUND, problem),
        }
    }

    /// Checks, simulates or writes a change.
    async fn change(&self, edit: &Editing, path: &str, body: &[u8]) -> Answer {
        let proposal = match Proposal::read(body) {
            Ok(proposal) => proposal,
            Err(problem) => return not_edited(&problem),
        };
        match path {
            "/api/annotations/check" => self.editing(edit, move |edit| annotations::proposed(&edit, &proposal)).await,
            "/api/annotations/save" => self.editing(edit, move |edit| annotations::saved(&edit, &proposal)).await,
            _ => match annotations::gained(edit, proposal).await {
                Ok(gained) => json(&gained),
                Err(problem) => not_edited(&problem),
            },
        }
    }

    /// Reads and checks the task file in a blocking thread.
    async fn editing<T: Serialize + Send + 'static>(
        &self,
        edit: &Editing,
        work: impl FnOnce(Editing) -> Result<T, Problem> + Send + 'static,
    ) -> Answer {
        let Ok(_place) = self.reading.acquire().await else {
            return Answer::Refused(StatusCode::SERVICE_UNAVAILABLE, "the dashboard ends".to_owned());
        };
        let edit = edit.clone();
        match tokio::task::spawn_blocking(move || work(edit)).await {
            Ok(Ok(told)) => json(&told),
            Ok(Err(problem)) => not_edited(&problem),
            Err(_) => {
                let problem = "checking the task file ended with a panic".to_owned();
                Answer::Refused(StatusCode::INTERNAL_SERVER_ERROR, problem)
            }
        }
    }

    /// The refusal if the pages are read-only.
    fn only_looks(&self) -> Option<Answer> {
        let problem = "these pages only look: `ratn dashboard --control` lets them steer runs and pools";
        (!self.control).then(|| Answer::Refused(StatusCode::FORBIDDEN, problem.to_owned()))
    }

    async fn scale(&self, query: &Query<'_>) -> Answer {
        if let Some(refusal) = self.only_looks() {
            return refusal;
        }
        let number = |name: &str| match query.text(name).as_str() {
            "" => Ok(None),
            text => text.parse().map(Some).map_err(|_| format!("`{name}={text}` is no number of workers")),
        };
        let scale = match (number("min"), number("max"), number("spares")) {
            (Ok(min), Ok(max), Ok(spares)) => Scale { min, max, spares },
            (Err(problem), _, _) | (_, Err(problem), _) | (_, _, Err(problem)) => {
                return Answer::Refused(StatusCode::BAD_REQUEST, problem);
            }
        };
        let template = query.text("template");
        match self.system.scale(&query.text("host"), &template, scale).await {
            Ok(()) => json(&wire::Told { said: format!("The pool {template} is scaled.") }),
            Err(problem) => Answer::Refused(StatusCode::CONFLICT, problem),
        }
    }

    async fn control(&self, query: &Query<'_>) -> Answer {
        if let Some(refusal) = self.only_looks() {
            return refusal;
        }
        let word = match query.text("word").as_str() {
            "pause" => Told::Word(Word::Pause, "The run is paused: no further motion begins."),
            "resume" => Told::Word(Word::Resume, "The run goes on."),
            "step" => Told::Word(Word::Step, "One more motion may begin, then the run is paused."),
            "abort" => Told::Word(Word::Abort, "The run is told to end: what moves stops and holds."),
            "answer" => Told::Answer { state: query.text("state"), choice: query.text("choice") },
            "signal" => Told::Signal(query.text("signal")),
            "break" if query.text("state").is_empty() => {
                let problem = "say before which state the run shall pause: `state=PATH`".to_owned();
                return Answer::Refused(StatusCode::BAD_REQUEST, problem);
            }
            "break" => Told::Breakpoint { state: Some(query.text("state")), set: true },
            "clear" => {
                let state = Some(query.text("state")).filter(|state| !state.is_empty());
                Told::Breakpoint { state, set: false }
            }
            other => {
                let problem = format!(
                    "a run can be told pause, resume, step, abort, answer, signal, break and clear, and not `{other}`"
                );
                return Answer::Refused(StatusCode::BAD_REQUEST, problem);
            }
        };
        // The page names the run it means: another one may have begun since.
        self.hear().await;
        let Some(run) = query.number("log").and_then(|id| self.logs.run_of(id)) else {
            let problem = "no run writes this log any more".to_owned();
            return Answer::Refused(StatusCode::CONFLICT, problem);
        };
        let said = match word {
            Told::Word(word, said) => self.system.tell(&run, word).await.map(|()| said.to_owned()),
            Told::Answer { state, choice } => {
                self.system.send(&Message::Answer { run, state: Some(state), choice }).await
            }
            Told::Signal(signal) => self.system.send(&Message::Signal { run, signal, value: Value::Null }).await,
            Told::Breakpoint { state, set } => self.system.send(&Message::Breakpoint { run, state, set }).await,
        };
        match said {
            Ok(said) => json(&wire::Told { said }),
            Err(error) if control::is_nobody(&error) => {
                Answer::Refused(StatusCode::CONFLICT, "no run is under way".to_owned())
            }
            Err(error) => Answer::Refused(StatusCode::BAD_GATEWAY, format!("the run does not take that: {error}")),
        }
    }
}

/// The query part of a URL, after `?`.
struct Query<'q>(&'q str);

impl<'q> Query<'q> {
    fn of(text: &'q str) -> Query<'q> {
        Query(text)
    }

    /// The decoded value of a parameter; empty if it is missing.
    fn text(&self, name: &str) -> String {
        let pairs = self.0.split('&').filter_map(|pair| pair.split_once('='));
        let value = pairs.filter(|(key, _)| *key == name).map(|(_, value)| value).next().unwrap_or_default();
        let (mut bytes, mut rest) = (Vec::with_capacity(value.len()), value.as_bytes());
        while let Some((first, behind)) = rest.split_first() {
            rest = behind;
            let hex = behind.get(..2).and_then(|two| std::str::from_utf8(two).ok());
            match (first, hex.and_then(|two| u8::from_str_radix(two, 16).ok())) {
                (b'%', Some(byte)) => {
                    bytes.push(byte);
                    rest = &behind[2..];
                }
                (b'+', _) => bytes.push(b' '),
                (byte, _) => bytes.push(*byte),
            }
        }
        String::from_utf8_lossy(&bytes).into_owned()
    }

    fn number(&self, name: &str) -> Option<u64> {
        self.text(name).parse().ok()
    }

    /// The log asked for, and what the page knows of it.
    fn asked(&self) -> Result<(u64, Asked), String> {
        let id = self.number("log").ok_or("say which log: `log=NUMBER`, as /api/about lists them")?;
        let at_s = match self.text("at").as_str() {
            "" => None,
            text => {
                let moment = text.parse::<f64>().ok().filter(|moment| moment.is_finite() && *moment >= 0.0);
                Some(moment.ok_or_else(|| format!("`at={text}` is no moment in seconds"))?)
            }
        };
        let epoch = self.number("epoch").unwrap_or_default();
        let version = self.number("version").unwrap_or_default();
        let about = self.number("about").map(InstanceId);
        Ok((id, Asked { at_s, epoch, version, about }))
    }
}

fn not_edited(problem: &Problem) -> Answer {
    let status = match problem {
        Problem::Question(_) => StatusCode::BAD_REQUEST,
        Problem::Changed { .. } => StatusCode::CONFLICT,
        Problem::File(_) | Problem::Edit(_) | Problem::Value { .. } | Problem::Refused { .. } => {
            StatusCode::UNPROCESSABLE_ENTITY
        }
    };
    Answer::Refused(status, problem.to_string())
}

fn json(value: &impl Serialize) -> Answer {
    match serde_json::to_string(value) {
        Ok(text) => Answer::Json(text),
        Err(error) => Answer::Refused(StatusCode::INTERNAL_SERVER_ERROR, error.to_string()),
    }
}

fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(inner) = source {
        text.push_str(&format!(": {inner}"));
        source = inner.source();
    }
    text
}

fn refusal(status: StatusCode, problem: &str) -> Response<Full<Bytes>> {
    let refusal = wire::Refusal { problem: problem.to_owned() };
    response(status, JSON, serde_json::to_string(&refusal).unwrap_or_default())
}

fn not_allowed(method: &'static str) -> Response<Full<Bytes>> {
    let mut response = refusal(StatusCode::METHOD_NOT_ALLOWED, &format!("only {method}"));
    response.headers_mut().insert(ALLOW, HeaderValue::from_static(method));
    response
}

fn response(status: StatusCode, kind: &'static str, body: impl Into<Bytes>) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(body.into()));
    *response.status_mut() = status;
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    for (name, value) in HEADERS {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}
