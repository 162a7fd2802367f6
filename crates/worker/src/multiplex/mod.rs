//! Multiplexes many calls over one bidirectional stream, by id: no call pays for an HTTP/2 stream of its own.
//!
//! ```text
//!   call ─▶ Multiplexer ─ id, call ──▶ Answers ─▶ Serve::begin
//!    ▲                                                │
//!    └────── by its id ◀── id, answer … last answer ◀─┘
//! ```
//! `client::Multiplexer` is the client side, [`server::Answers`] the server side. A dropped call is reported to the other side. A stream
//! that breaks fails its calls at the client and drops them at the server. A [`Protocol`] defines the messages; this module knows nothing
//! of them.

pub(crate) mod client;
pub mod server;

use ratn_proto::v1::{self, CallFailure, LeaveRequest, WithdrawRequest};
use ratn_proto::v1::{calls_request, calls_response};
use ratn_proto::v1::{perform_request, perform_response, session_request, session_response};
use tonic::{Code, Status};

/// The messages of one streaming method.
pub trait Protocol: 'static {
    /// A call with its id, as sent.
    type Request: Send + 'static;
    /// An answer with the id of its call, as sent.
    type Response: Send + 'static;
    /// A call.
    type Call: Send + 'static;
    /// An answer.
    type Answer: Send + 'static;

    /// Makes a request from its parts; the last one is the W3C trace context, empty for none.
    fn request(id: u64, call: Self::Call, traceparent: String) -> Self::Request;

    /// The parts of a request.
    fn parts(request: Self::Request) -> (u64, Option<Self::Call>, String);

    /// Makes a response from its parts.
    fn response(id: u64, answer: Result<Self::Answer, Status>) -> Self::Response;

    /// The parts of a response.
    fn answer(response: Self::Response) -> (u64, Result<Self::Answer, Status>);

    /// The path of the method that this call would have as a separate call.
    fn path(call: &Self::Call) -> &'static str;

    /// Whether this is the last answer of its call.
    fn is_last(_: &Self::Answer) -> bool {
        true
    }

    /// Whether a caller that falls behind may miss this intermediate answer.
    fn may_be_missed(_: &Self::Answer) -> bool {
        true
    }

    /// The id of the call that this call ends; `id` is this call's own.
    fn ends_call(id: u64, call: &Self::Call) -> Option<u64>;

    /// The call, with its id, that a client sends when it drops this call before the last answer.
    fn when_dropped(id: u64, call: &Self::Call) -> Option<(u64, Self::Call)>;
}

/// Message conversions, which have the same form for all methods.
macro_rules! messages {
    ($request:ident $call:ident, $response:ident $answer:ident) => {
        type Request = v1::$request;
        type Response = v1::$response;
        type Call = $call::Kind;
        type Answer = $answer::Kind;

        fn request(id: u64, call: $call::Kind, traceparent: String) -> v1::$request {
            v1::$request { id, kind: Some(call), traceparent }
        }

        fn parts(request: v1::$request) -> (u64, Option<$call::Kind>, String) {
            (request.id, request.kind, request.traceparent)
        }

        fn response(id: u64, answer: Result<$answer::Kind, Status>) -> v1::$response {
            let kind = answer.unwrap_or_else(|status| $answer::Kind::Failure(failure(&status)));
            v1::$response { id, kind: Some(kind) }
        }

        fn answer(response: v1::$response) -> (u64, Result<$answer::Kind, Status>) {
            let answer = match response.kind {
                Some($answer::Kind::Failure(failure)) => Err(status(failure)),
                Some(answer) => Ok(answer),
                None => Err(Status::internal("an answer without a kind")),
            };
            (response.id, answer)
        }
    };
}

/// The calls of one client at the resource manager (block, acquire, release): `ResourceService.Session`.
#[derive(Debug)]
pub enum SessionCalls {}

impl Protocol for SessionCalls {
    messages!(SessionRequest session_request, SessionResponse session_response);

    fn path(call: &session_request::Kind) -> &'static str {
        use session_request::Kind;
        match call {
            Kind::Block(_) => "/ratn.v1.ResourceService/Block",
            Kind::Acquire(_) => "/ratn.v1.ResourceService/Acquire",
            Kind::Withdraw(_) => "/ratn.v1.ResourceService/Withdraw",
            Kind::Release(_) => "/ratn.v1.ResourceService/Release",
            Kind::KeepAlive(_) => "/ratn.v1.ResourceService/KeepAlive",
        }
    }

    fn ends_call(_: u64, call: &session_request::Kind) -> Option<u64> {
        match call {
            session_request::Kind::Withdraw(withdraw) if withdraw.call != 0 => Some(withdraw.call),
            _ => None,
        }
    }

    /// Only a request that waits in a queue has to be undone. An older server looks only at the request id, and answers.
    fn when_dropped(id: u64, call: &session_request::Kind) -> Option<(u64, session_request::Kind)> {
        use session_request::Kind;
        let (request_id, session_id) = match call {
            Kind::Block(block) => (&block.request_id, &block.session_id),
            Kind::Acquire(acquire) => (&acquire.request_id, &acquire.session_id),
            Kind::KeepAlive(_) | Kind::Release(_) | Kind::Withdraw(_) => return None,
        };
        let (request_id, session_id) = (request_id.clone(), session_id.clone());
        Some((0, Kind::Withdraw(WithdrawRequest { request_id, session_id, call: id, unheard: false })))
    }
}

/// The goals that one client gives to a provider: `ActionService.Perform`.
#[derive(Debug)]
pub enum GoalCalls {}

impl Protocol for GoalCalls {
    messages!(PerformRequest perform_request, PerformResponse perform_response);

    fn path(_: &perform_request::Kind) -> &'static str {
        "/ratn.v1.ActionService/Execute"
    }

    fn is_last(answer: &perform_response::Kind) -> bool {
        !matches!(answer, perform_response::Kind::Progress(_) | perform_response::Kind::Improved(_))
    }

    fn may_be_missed(answer: &perform_response::Kind) -> bool {
        matches!(answer, perform_response::Kind::Progress(_))
    }

    fn ends_call(id: u64, call: &perform_request::Kind) -> Option<u64> {
        matches!(call, perform_request::Kind::Leave(_)).then_some(id)
    }

    fn when_dropped(id: u64, _: &perform_request::Kind) -> Option<(u64, perform_request::Kind)> {
        Some((id, perform_request::Kind::Leave(LeaveRequest {})))
    }
}

/// The calls of one client at the world pool (commit, project, release): `WorldPoolService.Calls`.
#[derive(Debug)]
pub enum WorldCalls {}

impl Protocol for WorldCalls {
    messages!(CallsRequest calls_request, CallsResponse calls_response);

    fn path(call: &calls_request::Kind) -> &'static str {
        use calls_request::Kind;
        match call {
            Kind::Commit(_) => "/ratn.v1.WorldPoolService/Commit",
            Kind::Project(_) => "/ratn.v1.WorldPoolService/Project",
            Kind::Release(_) => "/ratn.v1.WorldPoolService/Release",
        }
    }

    fn ends_call(_: u64, _: &calls_request::Kind) -> Option<u64> {
        None
    }

    /// A dropped call is performed all the same: a commit may be in effect already, and a projection ends with its lease.
    fn when_dropped(_: u64, _: &calls_request::Kind) -> Option<(u64, calls_request::Kind)> {
        None
    }
}

fn failure(status: &Status) -> CallFailure {
    CallFailure { code: status.code().into(), message: status.message().to_owned(), details: status.details().to_vec() }
}

fn status(failure: CallFailure) -> Status {
    Status::with_details(Code::from(failure.code), failure.message, failure.details.into())
}
