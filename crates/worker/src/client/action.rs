//! The client of action services: workers, and the modules of the robot.

use super::retry::{PAUSE, TRIES};
use super::{CallError, Channels, chain};
use crate::endpoint::Endpoint;
use crate::multiplex::client::end_of_stream;
use crate::trace::Traced;
use ratn_model::catalogue::WorkerDescription;
use ratn_model::value::Value;
use ratn_proto::MAX_MESSAGE_BYTES;
use ratn_proto::convert::{MAX_DESCRIPTION_BYTES, Malformed, ports};
use ratn_proto::types::{Goal, GoalImproved, GoalOutcome};
use ratn_proto::v1;
use ratn_proto::v1::action_service_client::ActionServiceClient;
use ratn_proto::v1::execute_response::Kind;
use ratn_proto::v1::perform_request::Kind as Asked;
use ratn_proto::v1::perform_response::Kind as Heard;
use std::collections::BTreeMap;
use std::time::Duration;
use tonic::{Code, Status};

/// Interval between cancels while the provider does not know the goal yet.
const STOP_AGAIN: Duration = Duration::from_millis(50);

/// Gives goals to providers.
#[derive(Debug, Clone)]
pub struct ActionClient {
    channels: Channels,
}

/// What a provider can do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProviderInfo {
    /// The id of its resource; empty for none.
    pub resource: String,
    /// Sorted by name.
    pub actions: Vec<ActionInfo>,
}

/// A message of a goal before its end.
#[derive(Debug, Clone, PartialEq)]
pub enum Said {
    /// A progress report.
    Progress {
        /// For people and for the event log.
        message: String,
        /// Named values beside the message.
        values: BTreeMap<String, Value>,
    },
    /// An intermediate result that can be used; the goal goes on for a better one.
    Improved(GoalImproved),
}

/// How a goal ended that was given earlier.
#[derive(Debug, Clone, PartialEq)]
pub struct Fate {
    /// How it ended.
    pub outcome: GoalOutcome,
    /// The goal was stopped because no client listened or its lease had ended: the outcome says nothing of the action.
    pub orphaned: bool,
    /// Something may still move for the goal: its action has not returned, or it is not known whether a goal that it gave has ended.
    pub may_move: bool,
}

/// An action of a provider.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActionInfo {
    /// Its name.
    pub name: String,
    /// What it does, for people.
    pub description: String,
    /// Whether a goal is stopped when its last listener has gone.
    pub cancel_when_abandoned: bool,
}

/// Why the description of a worker cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DescribeError {
    /// The worker has no description, or cannot be reached.
    #[error("it does not describe itself: {0}")]
    Unanswered(String),
    /// The description exceeds the bounds.
    #[error("its description is refused: {0}")]
    Refused(String),
}

impl ActionClient {
    /// A client that uses these channels.
    pub fn new(channels: Channels) -> ActionClient {
        ActionClient { channels }
    }

    /// The channels.
    pub fn channels(&self) -> &Channels {
        &self.channels
    }

    /// Gives a goal to the provider and waits for its end. Dropping the future stops listening; the action decides whether its goal stops then
    /// ([`crate::action::Action`]).
    ///
    /// # Errors
    /// [`CallError::Refused`] when the provider did not take the goal. With any other error it is not known what became of the goal. Where the
    /// provider cannot reach the resource manager, the goal is given again for a while.
    pub async fn execute(
        &self,
        endpoint: &Endpoint,
        goal: Goal,
        on_progress: impl FnMut(String, BTreeMap<String, Value>),
    ) -> Result<GoalOutcome, CallError> {
        let performed = self.execute_hearing(endpoint, goal, || true, only_progress(on_progress));
        Box::pin(performed).await.map(|fate| fate.outcome)
    }

    /// As [`ActionClient::execute`], with the intermediate results that a goal gives before its end, and with all that is said of the end. When
    /// `wanted` returns false, the goal is not given again.
    ///
    /// # Errors
    /// As [`ActionClient::execute`].
    pub async fn execute_hearing(
        &self,
        endpoint: &Endpoint,
        goal: Goal,
        wanted: impl Fn() -> bool,
        mut on_said: impl FnMut(Said),
    ) -> Result<Fate, CallError> {
        let question = Question::Execute(v1::ExecuteRequest { goal: Some(goal.into()) });
        let mut tries = 1;
        loop {
            match self.listen(endpoint, question.clone(), &mut on_said).await {
                // The provider has begun nothing.
                Err(error) if error.is_unconfirmed() && tries < TRIES => {
                    tokio::time::sleep(PAUSE).await;
                    if !wanted() {
                        return Err(error);
                    }
                }
                ended => return ended,
            }
            tries += 1;
        }
    }

    /// Waits for the end of a goal that was given earlier, by this client or by another. Never begins the goal.
    ///
    /// # Errors
    /// As [`ActionClient::execute`]; [`CallError::Refused`] with `NotFound` if the provider does not know the goal: it was never given, the
    /// provider has been restarted, or the goal has been forgotten: with its lease or, without a lease, after many later goals.
    pub async fn attach(
        &self,
        endpoint: &Endpoint,
        goal: Goal,
        on_progress: impl FnMut(String, BTreeMap<String, Value>),
    ) -> Result<Fate, CallError> {
        Box::pin(self.attach_hearing(endpoint, goal, only_progress(on_progress))).await
    }

    /// As [`ActionClient::attach`], with the intermediate results that a goal gives from now on before its end. The call has a stream of its own:
    /// an answer about another goal cannot break it.
    ///
    /// # Errors
    /// As [`ActionClient::attach`].
    pub async fn attach_hearing(
        &self,
        endpoint: &Endpoint,
        goal: Goal,
        on_said: impl FnMut(Said),
    ) -> Result<Fate, CallError> {
        self.listen(endpoint, Question::Attach(v1::AttachRequest { goal: Some(goal.into()) }), on_said).await
    }

    async fn listen(
        &self,
        endpoint: &Endpoint,
        question: Question,
        mut on_said: impl FnMut(Said),
    ) -> Result<Fate, CallError> {
        let malformed = |m: Malformed| CallError::malformed(endpoint, m);
        let mut nonsense = None;
        let mut heard = |answer| {
            let said = match answer {
                Heard::Progress(progress) => {
                    let values = ports(progress.values, "progress.values");
                    values.map(|values| Said::Progress { message: progress.message, values })
                }
                Heard::Improved(better) => GoalImproved::try_from(better).map(Said::Improved),
                Heard::Result(_) | Heard::Failure(_) => return,
            };
            match said {
                Ok(said) => on_said(said),
                Err(error) => nonsense = Some(error),
            }
        };
        let answer = match question {
            Question::Attach(_) => Box::pin(self.alone(endpoint, question, heard)).await,
            Question::Execute(ref execute) => {
                let mut client = self.client(endpoint)?;
                let open = |questions| async move { client.perform(questions).await };
                let stream = self.channels.goals(endpoint);
                match stream.call_with_progress(open, Asked::Execute(execute.clone()), &mut heard).await {
                    // The provider implements only the call for a single goal.
                    Err(status) if status.code() == Code::Unimplemented => {
                        Box::pin(self.alone(endpoint, question, heard)).await
                    }
                    answer => answer,
                }
            }
        };
        let answer = answer.map_err(|status| CallError::from_status(endpoint, &status))?;
        let Heard::Result(result) = answer else {
            return Err(malformed(Malformed::new("kind", "is not that of a goal's end")));
        };
        if let Some(nonsense) = nonsense {
            return Err(malformed(nonsense));
        }
        let (orphaned, may_move) = (result.orphaned, result.may_move);
        Ok(Fate { outcome: result.try_into().map_err(malformed)?, orphaned, may_move })
    }

    /// Asks over a stream that no other goal shares.
    async fn alone(
        &self,
        endpoint: &Endpoint,
        question: Question,
        mut heard: impl FnMut(Heard),
    ) -> Result<Heard, Status> {
        let mut client = self.client(endpoint).map_err(|error| Status::unavailable(chain(&error)))?;
        let answers = match question {
            Question::Execute(question) => client.execute(question).await,
            Question::Attach(question) => client.attach(question).await,
        };
        let mut answers = answers?.into_inner();
        let mut is_begun = false;
        // Once the provider has begun the goal, a refusal is the end of the stream, and no answer of the provider.
        let ended = |is_begun: bool, status: Status| match status.code() {
            Code::PermissionDenied | Code::ResourceExhausted if is_begun => end_of_stream(status),
            _ => status,
        };
        while let Some(answer) = answers.message().await.map_err(|status| ended(is_begun, status))? {
            is_begun = true;
            match answer.kind {
                Some(Kind::Progress(progress)) => heard(Heard::Progress(progress)),
                Some(Kind::Improved(better)) => heard(Heard::Improved(better)),
                Some(Kind::Result(result)) => return Ok(Heard::Result(result)),
                Some(Kind::Accepted(_)) | None => {}
            }
        }
        Err(Status::unavailable("the stream ended without the goal's result"))
    }

    /// Tells a goal to stop. False if it was not under way. [`ActionClient::execute`] returns the outcome.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn cancel(&self, endpoint: &Endpoint, goal: &str) -> Result<bool, CallError> {
        let question = v1::CancelRequest { goal_id: goal.to_owned() };
        let answer = self.client(endpoint)?.cancel(question).await;
        Ok(answer.map_err(|status| CallError::from_status(endpoint, &status))?.into_inner().under_way)
    }

    /// Tells a goal to stop until that is heard: a goal and its cancel travel on different paths, and a goal whose call is being repeated may
    /// arrive after the cancel. Returns also if the provider refuses.
    pub async fn stop(&self, endpoint: &Endpoint, goal: &str) {
        while match self.cancel(endpoint, goal).await {
            Ok(under_way) => !under_way,
            Err(error) => error.is_crash(),
        } {
            tokio::time::sleep(STOP_AGAIN).await;
        }
    }

    /// The actions of a provider.
    ///
    /// # Errors
    /// [`CallError`].
    pub async fn describe(&self, endpoint: &Endpoint) -> Result<ProviderInfo, CallError> {
        let answer = self.client(endpoint)?.describe(v1::DescribeRequest {}).await;
        let answer = answer.map_err(|status| CallError::from_status(endpoint, &status))?.into_inner();
        let info = |a: v1::ActionDescription| ActionInfo {
            name: a.name,
            description: a.description,
            cancel_when_abandoned: a.cancel_when_abandoned,
        };
        Ok(ProviderInfo { resource: answer.resource_id, actions: answer.actions.into_iter().map(info).collect() })
    }

    /// The description of a worker, with the signatures of its actions. Waits at most `within`.
    ///
    /// # Errors
    /// [`DescribeError`].
    pub async fn description(&self, endpoint: &Endpoint, within: Duration) -> Result<WorkerDescription, DescribeError> {
        let channel = self.channels.to_provider(endpoint).map_err(|error| DescribeError::Unanswered(chain(&error)))?;
        let mut client = ActionServiceClient::new(channel).max_decoding_message_size(MAX_DESCRIPTION_BYTES);
        let answer = tokio::time::timeout(within, client.describe(v1::DescribeRequest {})).await;
        let late = |_| DescribeError::Unanswered(format!("no answer within {:.1} s", within.as_secs_f64()));
        let answer = answer.map_err(late)?.map_err(|status| match status.code() {
            // The decoder reports this code when the size limit is exceeded.
            Code::OutOfRange => DescribeError::Refused(format!("it has more than {MAX_DESCRIPTION_BYTES} bytes")),
            _ => DescribeError::Unanswered(chain(&CallError::from_status(endpoint, &status))),
        })?;
        WorkerDescription::try_from(answer.into_inner()).map_err(|error| DescribeError::Refused(error.to_string()))
    }

    fn client(&self, endpoint: &Endpoint) -> Result<ActionServiceClient<Traced>, CallError> {
        Ok(ActionServiceClient::new(self.channels.to_provider(endpoint)?)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES))
    }
}

/// What is asked about a goal.
#[derive(Clone)]
enum Question {
    /// Performs it.
    Execute(v1::ExecuteRequest),
    /// Joins it where it is known.
    Attach(v1::AttachRequest),
}

/// A listener for progress reports alone.
fn only_progress(mut on_progress: impl FnMut(String, BTreeMap<String, Value>)) -> impl FnMut(Said) {
    move |said| {
        if let Said::Progress { message, values } = said {
            on_progress(message, values);
        }
    }
}
