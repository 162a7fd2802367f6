//! Searches for a better dispatch order in one thread while the run goes on: the input is the rest of the window, the output is an event with advice
//! if a better order was found. Advice is logged, so a replay needs no search.
//!
//! Bounded: one thread; a new problem replaces the previous one; each is searched for at most [`THINKING`], and only if more time than that can be
//! gained; at most one problem is given per [`PAUSE`], when enough has changed ([`ratn_executive::lookahead::Lookout`]). Each search starts from the
//! good orders of the previous one, so that a long run is searched for a long time.

use ratn_executive::lookahead::{Memory, Problem, Search};
use ratn_executive::protocol::Event;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;

/// Maximum wall time for one search.
const THINKING: Duration = Duration::from_millis(50);
/// Minimum wall time between two searches.
pub(super) const PAUSE: Duration = Duration::from_millis(200);
/// Number of orders that are simulated between two reads of the clock.
const ORDERS: usize = 32;
/// A gain below this fraction of the remaining time does not justify a new round of acquires.
const WORTHWHILE: f64 = 0.002;
/// Maximum number of pieces of advice that the run has not received yet.
const MAX_PENDING: usize = 2;

/// The search thread, and the state shared with it.
#[derive(Debug)]
pub(super) struct Advisor {
    context: Arc<TurnContext>,
    advice: mpsc::Receiver<Event>,
}

#[derive(Debug, Default)]
struct TurnContext {
    question: Mutex<Question>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct Question {
    problem: Option<Problem>,
    /// The advisor was dropped.
    is_over: bool,
}

impl Advisor {
    /// Starts the thread, which waits for problems. `seed` is the seed of the search.
    ///
    /// # Errors
    /// The thread cannot be started.
    pub(super) fn start(seed: u64) -> std::io::Result<Advisor> {
        let context = Arc::new(TurnContext::default());
        let (tell, advice) = mpsc::channel(MAX_PENDING);
        let at_desk = Arc::clone(&context);
        std::thread::Builder::new().name("look-ahead".to_owned()).spawn(move || at_desk.work(seed, &tell))?;
        Ok(Advisor { context, advice })
    }

    /// Gives a problem to search; it replaces the previous one.
    pub(super) fn ask(&self, problem: Problem) {
        self.context.change(|question| question.problem = Some(problem));
    }

    /// Resolves with the next advice.
    pub(super) async fn told(&mut self) -> Event {
        match self.advice.recv().await {
            Some(event) => event,
            None => std::future::pending().await,
        }
    }
}

impl Drop for Advisor {
    fn drop(&mut self) {
        self.context.change(|question| question.is_over = true);
    }
}

impl TurnContext {
    fn change(&self, change: impl FnOnce(&mut Question)) {
        change(&mut self.question.lock().unwrap_or_else(PoisonError::into_inner));
        self.changed.notify_one();
    }

    /// Waits for a problem; `None` when there will be no more.
    fn next(&self) -> Option<Problem> {
        let question = self.question.lock().unwrap_or_else(PoisonError::into_inner);
        let nothing = |question: &mut Question| question.problem.is_none() && !question.is_over;
        let mut question = self.changed.wait_while(question, nothing).unwrap_or_else(PoisonError::into_inner);
        if question.is_over { None } else { question.problem.take() }
    }

    fn has_news(&self) -> bool {
        let question = self.question.lock().unwrap_or_else(PoisonError::into_inner);
        question.is_over || question.problem.is_some()
    }

    fn work(&self, seed: u64, tell: &mpsc::Sender<Event>) {
        let mut asked = 0;
        let mut memory = Memory::default();
        while let Some(problem) = self.next() {
            asked += 1;
            if let Some(advice) = self.think(&problem, seed.wrapping_add(asked), &mut memory) {
                // A run that does not keep up gives a new problem later.
                let _ = tell.try_send(advice);
            }
        }
    }

    /// Advice with a better order than the present one, if one is found in time and no new problem arrives meanwhile.
    fn think(&self, problem: &Problem, seed: u64, memory: &mut Memory) -> Option<Event> {
        let mut search = Search::remembering(problem, seed, memory)
            .inspect_err(|error| tracing::debug!(%error, "no look ahead"))
            .ok()?;
        if !is_worthwhile(search.bound_s(), search.plain_s()) {
            return None;
        }
        let begun = Instant::now();
        while !search.is_over() && begun.elapsed() < THINKING {
            search.step(ORDERS);
            if self.has_news() {
                return None;
            }
        }
        *memory = search.memory();
        let best = search.best();
        // JSON has no infinity and no NaN: the log could not be read back.
        let is_usable = best.urgency_s.iter().all(|(_, seconds)| seconds.is_finite());
        let is_told = is_usable && is_worthwhile(best.end_s, best.plain_s) && !best.urgency_s.is_empty();
        is_told.then_some(Event::Advised { urgency_s: best.urgency_s, held: best.held })
    }
}

/// Whether an end time, in seconds from now, is earlier than the present one by more than it costs to find and send it. For many goals of a
/// millisecond each, no order is.
fn is_worthwhile(end_s: f64, plain_s: f64) -> bool {
    plain_s - end_s > (plain_s * WORTHWHILE).max(THINKING.as_secs_f64())
}

/// Whether a search can gain anything: something runs, and two waiting tasks want a kind with a bounded number of units.
pub(super) fn is_worth_asking(problem: &Problem) -> bool {
    let waiting = || problem.tasks.iter().filter(|task| !task.is_running);
    problem.tasks.iter().any(|task| task.is_running)
        && problem.capacity.keys().any(|kind| {
            let wants = |task: &&ratn_executive::lookahead::Task| task.demands.iter().any(|(of, _)| of == kind);
            waiting().filter(wants).nth(1).is_some()
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_executive::lookahead::Task;
    use ratn_model::id::InstanceId;

    fn task(id: u64, duration_s: f64, kind: &str, after: &[usize]) -> Task {
        Task {
            instance: InstanceId(id),
            duration_s,
            is_running: id == 0,
            demands: vec![(kind.to_owned(), 1.into())],
            after: after.to_vec(),
            is_speculative: false,
            held_for: Vec::new(),
            urgency_s: 0.0,
            probability: 1.0,
        }
    }

    /// The arm is busy; a long task waits for short task 2, and no task waits for task 1. No task is more urgent yet, so they are served in program
    /// order: task 1 first.
    fn problem() -> Problem {
        let tasks = vec![
            task(0, 1.0, "Arm", &[]),
            task(1, 9.0, "Arm", &[]),
            task(2, 1.0, "Arm", &[]),
            task(3, 9.0, "Oven", &[2]),
        ];
        Problem { tasks, capacity: [("Arm".to_owned(), 1.into()), ("Oven".to_owned(), 1.into())].into() }
    }

    #[tokio::test]
    async fn a_better_order_is_advised() -> anyhow::Result<()> {
        let mut advisor = Advisor::start(1)?;
        assert!(is_worth_asking(&problem()));
        advisor.ask(problem());
        let Event::Advised { urgency_s, .. } = advisor.told().await else { anyhow::bail!("no advice") };
        let urgency = |id| urgency_s.iter().find(|(instance, _)| *instance == InstanceId(id)).map(|(_, s)| *s);
        assert!(urgency(2) > urgency(1), "{urgency_s:?}");
        Ok(())
    }

    #[test]
    fn what_gains_less_than_it_costs_is_not_thought_about() -> anyhow::Result<()> {
        let capacity = [("Worker".to_owned(), 2.into())].into();
        let many = Problem { tasks: (0..101).map(|id| task(id, 0.0003, "Worker", &[])).collect(), capacity };
        let (of_many, of_few) = (Search::new(&many, 1)?, Search::new(&problem(), 1)?);
        assert!(is_worth_asking(&many) && !of_many.is_over() && !is_worthwhile(of_many.bound_s(), of_many.plain_s()));
        assert!(is_worthwhile(of_few.bound_s(), of_few.plain_s()));
        Ok(())
    }

    #[test]
    fn where_nothing_runs_or_nobody_competes_nothing_is_asked() {
        let alone = Problem { tasks: vec![task(0, 1.0, "Arm", &[]), task(1, 1.0, "Arm", &[])], ..problem() };
        assert!(!is_worth_asking(&alone));
        let idle = Problem { tasks: problem().tasks.split_off(1), ..problem() };
        assert!(!is_worth_asking(&Problem { tasks: idle.tasks[..2].to_vec(), ..problem() }));
    }
}
