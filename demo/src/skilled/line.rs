//! The line itself: a composite of skills that are found by what they can do. Where a skill is lost it goes on without it, and
//! takes back what that skill has left half done.

use std::sync::Arc;
use std::time::Duration;

use skills::{Outcome, Runs, SkillFault, Value};
use tokio::time::sleep;

use super::world::{BELT, BUCKET, PARK, STORAGE, WORKER};

/// The skills that the line is made of.
pub(super) struct Line {
    /// Brings things from one place to another.
    pub(super) pick_and_place: Arc<dyn Runs>,
    pub(super) conveyor: Arc<dyn Runs>,
    pub(super) base: Arc<dyn Runs>,
    /// How long the conveyor takes from its beginning to its end.
    pub(super) transport: Duration,
    /// How long a run of a skill may take.
    pub(super) within: Duration,
}

/// What the line tells of a step: which skill, and what for.
pub(super) trait Teller {
    /// A run begins.
    fn begins(&self, skill: &str, what: &str);
    /// It has ended, well or not.
    fn ended(&self, skill: &str, what: &str, message: &str);
    /// The line goes another way from now on.
    fn turns(&self, why: &str);
}

impl Line {
    /// Brings all covers to their places: by the conveyor for as long as there is one, else by the mobile robot.
    ///
    /// # Errors
    /// A skill without which there is no line did not do its work; why, for people.
    pub(super) async fn run(&self, covers: u32, teller: &dyn Teller) -> Result<(), String> {
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

    async fn switch_on(&self, teller: &dyn Teller) -> Result<(), String> {
        let on = vec![("On".to_owned(), Value::from(true))];
        ran(&*self.conveyor, on, ("runs", self.within), teller).await
    }

    /// Waits until the conveyor has carried away what lies on it, and asks it then whether it runs.
    async fn carried_away(&self, teller: &dyn Teller) -> Result<(), String> {
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
        teller: &dyn Teller,
    ) -> Result<(), String> {
        let what = format!("from the {} to the {}", place_name(pick), place_name(place));
        let parameters = vec![
            ("PickPosition".to_owned(), Value::from(pick)),
            ("PlacePosition".to_owned(), Value::from(place)),
        ];
        ran(
            &*self.pick_and_place,
            parameters,
            (&what, self.within),
            teller,
        )
        .await
    }

    /// The mobile robot brings what it has to the worker and comes back.
    async fn deliver(&self, teller: &dyn Teller) -> Result<(), String> {
        for (what, [x, y, heading]) in [("to the worker", WORKER), ("to the park", PARK)] {
            let goal = Value::from(vec![x, y, heading]);
            let goal = vec![("Goal".to_owned(), goal)];
            ran(&*self.base, goal, (what, self.within), teller).await?;
        }
        Ok(())
    }
}

async fn ran(
    skill: &dyn Runs,
    parameters: Vec<(String, Value)>,
    (what, within): (&str, Duration),
    teller: &dyn Teller,
) -> Result<(), String> {
    let name = skill.name();
    teller.begins(&name, what);
    let done = done(&name, skill.run(parameters, within).await);
    let message = done.as_ref().err().map_or("", String::as_str);
    teller.ended(&name, what, message);
    done
}

fn done(name: &str, ran: Result<Outcome, SkillFault>) -> Result<(), String> {
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
