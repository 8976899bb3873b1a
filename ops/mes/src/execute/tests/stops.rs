//! Runs that the caller stops.

use super::*;

/// Stops the run at this step.
pub(super) struct StopAt(pub(super) &'static str, pub(super) watch::Sender<bool>);

#[async_trait]
impl JobObserver for StopAt {
    async fn step(&self, step: &'static str) {
        if step == self.0 {
            self.1.send_replace(true);
        }
    }

    async fn stopped(&self) {
        let mut stop = self.1.subscribe();
        let told = stop.wait_for(|stop| *stop).await.is_ok();
        assert!(told, "the test is over");
    }
}

#[tokio::test]
async fn who_asked_can_stop_it_also_while_it_waits() {
    let teller = StopAt("Wait", watch::channel(false).0);
    let plant: Arc<dyn Plant> = Arc::new(Arc::new(plant(vec![])));
    let slow = Process {
        wait: Duration::from_secs(600),
        ..process()
    };
    let run = tokio::time::timeout(Duration::from_secs(5), execute(&plant, &slow, 1, &teller))
        .await
        .unwrap();
    assert_eq!(run.reason.as_deref(), Some("stopped"));
}

#[tokio::test]
async fn a_stop_does_not_wait_for_a_tool_changer_that_does_not_respond() {
    let mut fakes = plant(gripper("gripper"));
    let (silent, mut reads) = watch::channel(0);
    fakes.silent_tools = Some(silent);
    let plant: Arc<dyn Plant> = Arc::new(Arc::new(fakes));
    let teller = StopAt("Wait", watch::channel(false).0);
    let process = process();
    let stop = async {
        reads.wait_for(|reads| *reads > 0).await.unwrap();
        teller.1.send_replace(true);
    };
    let both = async { tokio::join!(execute(&plant, &process, 1, &teller), stop) };
    let (run, ()) = tokio::time::timeout(Duration::from_secs(5), both)
        .await
        .unwrap();
    assert_eq!(run.reason.as_deref(), Some("stopped"));
    assert!(run.plans.is_empty(), "{run:?}");
}
