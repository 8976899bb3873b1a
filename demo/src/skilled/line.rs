//! The line: a composite of skills that are found by their types. If a skill is lost, the line
//! continues without it, and takes back the cover that the skill has not delivered.

use std::sync::Arc;
use std::time::Duration;

use skills::{RunOutcome, RunnableSkill, SkillFault, SkillValue};
use tokio::time::sleep;

use super::world::{BELT, BUCKET, PARK, STORAGE, WORKER};

/// The skills of the line.
pub(super) struct SkilledLine {
    /// Moves objects from one pose to another.
    pub(super) pick_and_place: Arc<dyn RunnableSkill>,
    pub(super) conveyor: Arc<dyn RunnableSkill>,
    pub(super) base: Arc<dyn RunnableSkill>,
    /// Time that the conveyor takes to move a cover from its start to its end.
    pub(super) transport: Duration,
    /// Time limit of a run of a skill.
    pub(super) within: Duration,
}

/// Receives the progress of the line: the skill and its purpose.
pub(super) trait ProgressReporter {
    /// A run starts.
    fn begins(&self, skill: &str, what: &str);
    /// A run has ended, with or without success.
    fn ended(&self, skill: &str, what: &str, message: &str);
    /// The line continues in another way.
    fn turns(&self, why: &str);
}

impl SkilledLine {
    /// Brings all covers to the worker: by the conveyor while it is available, then by the mobile
    /// robot.
    ///
    /// # Errors
    /// The reason why an indispensable skill failed, as text for people.
    pub(super) async fn run(
        &self,
        covers: u32,
        teller: &dyn ProgressReporter,
    ) -> Result<(), String> {
        let mut conveyor = self.switch_on(teller).await;
        for number in 1..=covers {
            if let Err(why) = &conveyor {
                teller.turns(&format!("cover {number} goes by the mobile robot: {why}"));
                self.bring(STORAGE, BUCKET, teller).await?;
                self.deliver(teller).await?;
                continue;
            }
            self.bring(STORAGE, BELT, teller).await?;
            conveyor = self.carried_away(teller).await;
            if let Err(why) = &conveyor {
                teller.turns(&format!(
                    "cover {number} lies on a conveyor that is dead, and is taken back: {why}"
                ));
                self.bring(BELT, BUCKET, teller).await?;
                self.deliver(teller).await?;
            }
        }
        Ok(())
    }

    async fn switch_on(&self, teller: &dyn ProgressReporter) -> Result<(), String> {
        let on = vec![("On".to_owned(), SkillValue::from(true))];
        ran(&*self.conveyor, on, ("runs", self.within), teller).await
    }

    /// Waits until the conveyor has delivered its covers, and then checks that it still runs.
    async fn carried_away(&self, teller: &dyn ProgressReporter) -> Result<(), String> {
        tokio::select! {
            why = self.conveyor.lost() => return Err(format!("{} is lost: {why}", self.conveyor.name())),
            () = sleep(self.transport) => {}
        }
        self.switch_on(teller).await
    }

    async fn bring(
        &self,
        pick: [f64; 6],
        place: [f64; 6],
        teller: &dyn ProgressReporter,
    ) -> Result<(), String> {
        let what = format!("from the {} to the {}", place_name(pick), place_name(place));
        let parameters = vec![
            ("PickPosition".to_owned(), SkillValue::from(pick)),
            ("PlacePosition".to_owned(), SkillValue::from(place)),
        ];
        ran(
            &*self.pick_and_place,
            parameters,
            (&what, self.within),
            teller,
        )
        .await
    }

    /// Sends the mobile robot with its cover to the worker and back.
    async fn deliver(&self, teller: &dyn ProgressReporter) -> Result<(), String> {
        for (what, [x, y, heading]) in [("to the worker", WORKER), ("to the park", PARK)] {
            let goal = SkillValue::from(vec![x, y, heading]);
            let goal = vec![("Goal".to_owned(), goal)];
            ran(&*self.base, goal, (what, self.within), teller).await?;
        }
        Ok(())
    }
}

async fn ran(
    skill: &dyn RunnableSkill,
    parameters: Vec<(String, SkillValue)>,
    (what, within): (&str, Duration),
    teller: &dyn ProgressReporter,
) -> Result<(), String> {
    let name = skill.name();
    teller.begins(&name, what);
    let done = done(&name, skill.run(parameters, within).await);
    let message = done.as_ref().err().map_or("", String::as_str);
    teller.ended(&name, what, message);
    done
}

fn done(name: &str, ran: Result<RunOutcome, SkillFault>) -> Result<(), String> {
    match ran {
        Ok(outcome) if outcome.succeeded => Ok(()),
        Ok(outcome) => Err(format!("{name} failed: {}", outcome.message)),
        Err(fault) => Err(format!("{name}: {fault}")),
    }
}

fn place_name(at: [f64; 6]) -> &'static str {
    if at == STORAGE {
        "storage"
    } else if at == BELT {
        "conveyor"
    } else {
        "bucket"
    }
}
