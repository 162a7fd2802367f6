//! `ratn control pause|resume|step|abort|break|clear`.

use super::{blocking_on, signal};
use crate::arguments::{ControlArguments, WordArgument};
use crate::failure::Failure;
use crate::output;
use crate::system::public_directory;
use anyhow::Context;
use ratn_task_control::control::{self, Message, RunStatus, Word};

/// Sends a control word to a run of a system.
pub(crate) fn run(arguments: &ControlArguments) -> Result<(), Failure> {
    let state = arguments.state.clone();
    let breakpoint = |set| Message::Breakpoint { run: arguments.run.clone(), state: state.clone(), set };
    let word = match arguments.word {
        WordArgument::Break => return signal::send(arguments.runtime_dir.as_deref(), &breakpoint(true)),
        WordArgument::Clear => return signal::send(arguments.runtime_dir.as_deref(), &breakpoint(false)),
        WordArgument::Pause => Word::Pause,
        WordArgument::Resume => Word::Resume,
        WordArgument::Step => Word::Step,
        WordArgument::Abort => Word::Abort,
    };
    if let Some(state) = state {
        return Err(Failure::Refused(format!("ratn: `{state}` is for `break` and `clear` only: leave it out")));
    }
    blocking_on(tokio::runtime::Builder::new_current_thread(), async {
        let directory = public_directory(arguments.runtime_dir.as_deref())?;
        // Asked before and after: an aborted run may be gone afterwards.
        let run = &arguments.run;
        let before = control::status(&directory, run).await.ok().flatten();
        let told = control::tell(&directory, run, word).await;
        let place = directory.display();
        match told {
            Err(error) if control::is_nobody(&error) => {
                Err(anyhow::anyhow!("no run is under way in {place}: say the `--runtime-dir` of its system").into())
            }
            told => {
                told.with_context(|| format!("the run in {place} does not take that"))?;
                let run = control::status(&directory, run).await.ok().flatten().or(before);
                Ok(output::result(said(word, run.as_ref()))?)
            }
        }
    })
}

/// A sentence about what the run does now.
fn said(word: Word, run: Option<&RunStatus>) -> String {
    let task = run.map_or("the run", |run| run.task.as_str());
    let what = match word {
        Word::Pause => "is paused: no PIA begins any more; `ratn control step` lets one begin, `resume` all",
        Word::Resume => "goes on",
        Word::Step => "may begin one more PIA, and is paused then",
        Word::Abort => {
            "is told to end: what moves stops and holds, and everything is given back; if it is paused, its ways out (`finally`) wait for `ratn control resume`"
        }
    };
    let under_way: Vec<&str> = run.into_iter().flat_map(|run| &run.under_way).map(|one| one.path.as_str()).collect();
    match under_way.as_slice() {
        [] => format!("{task} {what}"),
        paths => format!("{task} {what}; under way: {}", paths.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratn_executive::protocol::Mode;
    use ratn_task_control::progress::UnderWay;

    #[test]
    fn what_was_done_is_said_with_what_goes_on() {
        let run = RunStatus {
            run: "run-1".to_owned(),
            task: "fetch".to_owned(),
            mode: Mode::Hsm,
            log: "l".into(),
            at_s: 1.0,
            share: 1.0,
            due_in_s: None,
            paused: true,
            ended: 0,
            under_way: vec![UnderWay {
                path: "move[1]".to_owned(),
                for_s: 0.5,
                usually_s: None,
                message: String::new(),
            }],
            waits: Vec::new(),
            awaits: Vec::new(),
            breakpoints: Vec::new(),
        };
        let pause = said(Word::Pause, Some(&run));
        assert!(pause.starts_with("fetch is paused") && pause.ends_with("under way: move[1]"), "{pause}");
        assert_eq!(said(Word::Resume, None), "the run goes on");
    }
}
