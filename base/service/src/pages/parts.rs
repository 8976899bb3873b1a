//! The parts of the pages: a part for each run loop, and for each program that does not run.

use std::fmt;
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard};
use std::time::Duration;

use serde_json::json;
use tokio::sync::{mpsc, oneshot};

use super::{PageState, Requests};

/// Requests the status of a run loop.
pub type Ask<T> = mpsc::Sender<oneshot::Sender<T>>;

/// The channels between the pages and the run loops of a program.
pub struct RunLoops<T> {
    /// The senders, in the order of the spaces.
    pub asks: Vec<Ask<T>>,
    /// The receivers, the last first: the caller pops them in the order of the spaces.
    pub requests: Vec<Requests<T>>,
}

/// Returns the channels of some run loops.
#[must_use]
pub fn loops<T>(count: usize) -> RunLoops<T> {
    let (asks, mut requests): (Vec<_>, Vec<_>) = (0..count).map(|_| mpsc::channel(4)).unzip();
    requests.reverse();
    RunLoops { asks, requests }
}

/// The programs of the pages, in their order.
pub(super) struct PageParts<T>(Arc<RwLock<Vec<PagePart<T>>>>);

/// A program of the pages.
struct PagePart<T> {
    program: &'static str,
    state: PartState<T>,
}

/// The state of a program.
enum PartState<T> {
    /// The program has these run loops, in the order of their spaces.
    Running(Vec<Ask<T>>),
    /// The program does not run, for this reason.
    Down(String),
}

/// The answers for a page.
pub(super) struct PageAnswers<T> {
    pub(super) shown: Vec<ShownPart<T>>,
    /// Number of answers if all run loops answer.
    pub(super) expected: usize,
}

/// A part of the pages.
pub(super) enum ShownPart<T> {
    /// The status of a run loop.
    Running(T),
    /// A program that does not run, with the reason.
    Down {
        /// The name of the program.
        program: &'static str,
        /// The reason, as text for the user.
        why: String,
    },
}

impl<T> Clone for PartState<T> {
    fn clone(&self) -> Self {
        match self {
            Self::Running(asks) => Self::Running(asks.clone()),
            Self::Down(why) => Self::Down(why.clone()),
        }
    }
}

impl<T> Clone for PageParts<T> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<T> fmt::Debug for PageParts<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let programs = self.read();
        let names = programs.iter().map(|part| part.program);
        f.debug_list().entries(names).finish()
    }
}

impl<T> PageParts<T> {
    /// Returns the parts of programs that do not run yet.
    pub(super) fn new(programs: &[&'static str]) -> Self {
        let part = |program: &&'static str| PagePart {
            program,
            state: PartState::Down(STARTING.to_owned()),
        };
        Self(Arc::new(RwLock::new(programs.iter().map(part).collect())))
    }

    fn read(&self) -> RwLockReadGuard<'_, Vec<PagePart<T>>> {
        self.0.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn set(&self, program: &str, state: PartState<T>) {
        let mut parts = self.0.write().unwrap_or_else(PoisonError::into_inner);
        if let Some(part) = parts.iter_mut().find(|part| part.program == program) {
            part.state = state;
        }
    }

    /// Notes that a program runs with these run loops.
    pub(super) fn run(&self, program: &str, asks: Vec<Ask<T>>) {
        self.set(program, PartState::Running(asks));
    }

    /// Notes that a program does not run.
    pub(super) fn down(&self, program: &str, why: String) {
        self.set(program, PartState::Down(why));
    }

    fn asks(&self) -> Vec<Ask<T>> {
        let parts = self.read();
        let running = parts.iter().filter_map(|part| match &part.state {
            PartState::Running(asks) => Some(asks),
            PartState::Down(_) => None,
        });
        running.flatten().cloned().collect()
    }

    /// Completes when all run loops have ended.
    pub(super) async fn all_closed(&self) {
        for ask in self.asks() {
            ask.closed().await;
        }
    }

    /// Returns the status of each run loop, and the reason why a program does not run. All run
    /// loops are asked at once, so that several that hang cost no more time than one.
    pub(super) async fn answers(&self) -> PageAnswers<T>
    where
        T: Send + 'static,
    {
        let parts: Vec<(&'static str, PartState<T>)> = {
            let parts = self.read();
            let parts = parts.iter();
            parts
                .map(|part| (part.program, part.state.clone()))
                .collect()
        };
        let mut asked = Vec::new();
        for (program, state) in parts {
            match state {
                PartState::Running(asks) => {
                    let all = asks.into_iter().map(|ask| running_part(program, ask));
                    asked.extend(all.map(tokio::spawn));
                }
                PartState::Down(why) => {
                    let down = ShownPart::Down { program, why };
                    asked.push(tokio::spawn(async move { Some(down) }));
                }
            }
        }
        let expected = asked.len();
        let mut shown = Vec::new();
        for part in asked {
            shown.extend(part.await.ok().flatten());
        }
        PageAnswers { shown, expected }
    }
}

/// Returns the part of a run loop; `None` if it has ended.
async fn running_part<T>(program: &'static str, ask: Ask<T>) -> Option<ShownPart<T>> {
    match tokio::time::timeout(PATIENCE, answer(&ask)).await {
        Ok(status) => status.map(ShownPart::Running),
        Err(_) => Some(ShownPart::Down {
            program,
            why: format!("its run loop has not answered for {PATIENCE:?}"),
        }),
    }
}

/// Returns the status of a run loop; `None` if it has ended.
async fn answer<T>(ask: &Ask<T>) -> Option<T> {
    let (reply, status) = oneshot::channel();
    ask.send(reply).await.ok()?;
    status.await.ok()
}

impl<T: PageState> PageState for ShownPart<T> {
    fn json(&self) -> String {
        match self {
            Self::Running(status) => status.json(),
            Self::Down { program, why } => json!({
                "program": program, "version": build_info::version(), "not_ready": [why],
                "waiting_for": [], "topics": {},
            })
            .to_string(),
        }
    }

    fn prometheus(&self) -> String {
        match self {
            Self::Running(status) => status.prometheus(),
            Self::Down { program, .. } => format!("ua_ready{{program=\"{program}\"}} 0\n"),
        }
    }

    fn not_ready(&self) -> Vec<String> {
        match self {
            Self::Running(status) => status.not_ready(),
            Self::Down { program, why } => vec![format!("{program}: {why}\n")],
        }
    }

    fn waiting_for(&self) -> Vec<String> {
        match self {
            Self::Running(status) => status.waiting_for(),
            Self::Down { .. } => Vec::new(),
        }
    }
}

/// The reason why a program does not run before its first start.
const STARTING: &str = "it is starting";
/// How long a page waits for a run loop. A connection is closed later.
const PATIENCE: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests {
    use super::*;

    struct Fixed(&'static str);

    impl PageState for Fixed {
        fn json(&self) -> String {
            format!("{{\"program\":\"{}\"}}", self.0)
        }

        fn prometheus(&self) -> String {
            format!("ua_ready{{program=\"{}\"}} 1\n", self.0)
        }

        fn not_ready(&self) -> Vec<String> {
            Vec::new()
        }
    }

    fn answering(parts: &PageParts<Fixed>, count: usize, name: &'static str) {
        let RunLoops { asks, mut requests } = loops(count);
        parts.run(name, asks);
        while let Some(mut requests) = requests.pop() {
            tokio::spawn(async move {
                while let Some(reply) = requests.recv().await {
                    drop(reply.send(Fixed(name)));
                }
            });
        }
    }

    #[tokio::test]
    async fn each_program_has_a_part_while_another_is_down() {
        let parts = PageParts::new(&["bridge-ros1", "bridge-ros2"]);
        answering(&parts, 2, "bridge-ros2");
        parts.down("bridge-ros1", "no \"master\"".to_owned());
        let PageAnswers { shown, expected } = parts.answers().await;
        assert_eq!((shown.len(), expected), (3, 3));
        let [down, running, _] = shown.as_slice() else {
            panic!("three parts");
        };
        let status: serde_json::Value = serde_json::from_str(&down.json()).unwrap();
        assert_eq!(
            (&status["program"], &status["not_ready"]),
            (&json!("bridge-ros1"), &json!(["no \"master\""]))
        );
        assert_eq!(down.not_ready(), ["bridge-ros1: no \"master\"\n"]);
        assert_eq!(down.prometheus(), "ua_ready{program=\"bridge-ros1\"} 0\n");
        assert_eq!(running.json(), "{\"program\":\"bridge-ros2\"}");
        assert!(running.not_ready().is_empty());

        answering(&parts, 1, "bridge-ros1");
        let again = parts.answers().await.shown;
        assert!(again.iter().all(|part| part.not_ready().is_empty()));
    }

    #[tokio::test]
    async fn a_run_loop_is_asked_while_another_has_not_answered() {
        let parts = PageParts::<Fixed>::new(&["bridge-ros1"]);
        let RunLoops { asks, mut requests } = loops(2);
        parts.run("bridge-ros1", asks);
        tokio::spawn(async move {
            let [second, first] = requests.as_mut_slice() else {
                panic!("two run loops");
            };
            let of_second = second.recv().await.unwrap();
            let of_first = first.recv().await.unwrap();
            for reply in [of_second, of_first] {
                drop(reply.send(Fixed("bridge-ros1")));
            }
        });
        let PageAnswers { shown, expected } = parts.answers().await;
        assert_eq!((shown.len(), expected), (2, 2));
        assert!(shown.iter().all(|part| part.not_ready().is_empty()));
    }

    #[tokio::test]
    async fn a_run_loop_that_has_ended_does_not_answer() {
        let parts = PageParts::<Fixed>::new(&["bridge-ros1"]);
        parts.run("bridge-ros1", loops(1).asks);
        let PageAnswers { shown, expected } = parts.answers().await;
        assert_eq!((shown.len(), expected), (0, 1));
        parts.all_closed().await;
    }
}
