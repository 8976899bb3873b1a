//! Frees the memory of statements that were removed from the knowledge.

use std::sync::Arc;
use std::time::Duration;

use knowledge::Knowledge;
use tokio::task::spawn_blocking;
use tokio::time::{Instant, interval_at};
use tracing::{debug, warn};

/// Compacts the knowledge for as long as the program runs, on a thread of its own.
pub(crate) async fn compact(knowledge: Arc<Knowledge>) {
    let mut ticks = interval_at(Instant::now() + PERIOD, PERIOD);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        let knowledge = Arc::clone(&knowledge);
        let done = spawn_blocking(move || match knowledge.compact() {
            Ok(true) => debug!("freed the memory of removed statements"),
            Ok(false) => {}
            Err(error) => warn!(%error, "cannot free the memory of removed statements"),
        });
        if let Err(error) = done.await {
            warn!(%error, "the copy of the statements ended early");
        }
    }
}

/// Time between two checks whether there is memory to free.
const PERIOD: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests {
    use knowledge::{KnowledgeSource, SourceKind};

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn removed_statements_leave_the_memory_while_the_program_runs() {
        let knowledge = Arc::new(Knowledge::new().unwrap());
        let source = KnowledgeSource::new(SourceKind::Run, "1");
        let turtle: String = (0..10_000)
            .map(|number| format!("<urn:s{number}> <urn:p> {number} .\n"))
            .collect();
        let run = || {
            knowledge.replace_turtle(&source, &turtle, 0).unwrap();
            assert!(knowledge.remove(&source).unwrap());
        };
        run();
        assert!(knowledge.compact().unwrap(), "there is memory to free");
        run();
        let compacting = tokio::spawn(compact(Arc::clone(&knowledge)));
        tokio::time::sleep(PERIOD + Duration::from_millis(1)).await;
        // The task waits for the next tick when its thread has ended.
        tokio::time::sleep(PERIOD).await;
        assert!(!knowledge.compact().unwrap());
        compacting.abort();
    }
}
