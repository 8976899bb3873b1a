//! A plant whose skills do nothing and record their runs.

use std::sync::atomic::Ordering;

use super::*;
use crate::parameter_fault::ParameterFault;

/// A plant for tests. Its skills do nothing and record their runs.
pub(super) struct Fakes {
    pub(super) offers: Mutex<Vec<Offer>>,
    pub(super) changed: watch::Sender<u64>,
    pub(super) lost: watch::Sender<Vec<String>>,
    /// The skill that loses its component when it is run.
    pub(super) dies_at: Mutex<Option<&'static str>>,
    pub(super) fails_at: Option<&'static str>,
    /// A skill and how its run ends; `None` if it does not end.
    pub(super) ends: Option<(&'static str, Option<Result<RunOutcome, SkillFault>>)>,
    /// A skill that runs until it is halted, because the gripper is lost meanwhile.
    pub(super) halted_at: Mutex<Option<&'static str>>,
    pub(super) halts: watch::Sender<u32>,
    pub(super) unreachable: Option<&'static str>,
    /// Counts the reads of the tool changers, which do not respond; `None` if they do.
    pub(super) silent_tools: Option<watch::Sender<u32>>,
    /// Skills named `Meet` wait for each other here.
    pub(super) meets: Option<Arc<tokio::sync::Barrier>>,
    /// The results of the evaluations of queries, in their order.
    pub(super) found: Mutex<VecDeque<Result<serde_json::Value, ValueQueryFault>>>,
    /// Counts the evaluations after these, which do not end.
    pub(super) silent_queries: watch::Sender<u32>,
    pub(super) journal: Mutex<Vec<String>>,
    pub(super) kept: Mutex<Vec<ProcessRun>>,
    pub(super) clock: AtomicU64,
    pub(super) leases: Mutex<BTreeMap<String, String>>,
    /// Appears when a component is lost.
    pub(super) spare: Mutex<Vec<Offer>>,
    /// A skill, and the offers that appear when it is run.
    pub(super) powers: Option<(&'static str, Vec<Offer>)>,
    pub(super) tools: ShownTools,
    /// The component that moves the tool changers.
    pub(super) mover: Option<&'static str>,
    /// Incidents by the numbers of the runs of all skills, from 0.
    pub(super) mishaps: Mutex<BTreeMap<usize, Mishap>>,
}

impl Fakes {
    /// Loses a component.
    pub(super) fn lose(&self, component: &str) {
        let mut offers = self.offers.lock().unwrap();
        offers.retain(|offer| offer.component != component);
        self.lost
            .send_modify(|lost| lost.push(component.to_owned()));
    }
}

/// An incident of a run.
#[derive(Debug, Clone)]
pub(super) enum Mishap {
    /// The component of the skill is lost.
    Lost,
    /// The run of the skill ends so.
    Ends(Result<RunOutcome, SkillFault>),
    /// The run succeeds, and another component is lost meanwhile.
    Loses(&'static str),
}

struct FakeSkill {
    plant: Arc<Fakes>,
    offer: Offer,
}

#[async_trait]
impl Plant for Arc<Fakes> {
    fn offers(&self) -> Vec<Offer> {
        self.offers.lock().unwrap().clone()
    }

    fn changes(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    async fn open(&self, offers: &[Offer]) -> Result<Box<dyn Opened>, OpenFault> {
        if let Some(offer) = offers
            .iter()
            .find(|offer| Some(offer.component_name.as_str()) == self.unreachable)
        {
            return Err(OpenFault {
                component: offer.component.clone(),
                why: "no route".into(),
            });
        }
        let skill = |offer: &Offer| {
            Arc::new(FakeSkill {
                plant: Self::clone(self),
                offer: offer.clone(),
            }) as Arc<dyn RunnableSkill>
        };
        Ok(Box::new(FakeOpened(
            offers.iter().map(skill).collect(),
            Self::clone(self),
        )))
    }

    fn values(
        &self,
        _skill: &str,
        given: &[GivenParameter],
    ) -> Result<Vec<(String, SkillValue)>, ParameterFault> {
        given
            .iter()
            .filter(|given| given.result.is_none())
            .filter(|given| given.query.is_none() || !given.value.is_null())
            .map(|given| {
                let value = match given.value.as_str() {
                    Some(text) => SkillValue::String(text.to_owned()),
                    None => SkillValue::Double(given.value.as_f64().unwrap()),
                };
                Ok((given.name.clone(), value))
            })
            .collect()
    }

    async fn query(&self, _query: &ParameterQuery) -> Result<serde_json::Value, ValueQueryFault> {
        let found = self.found.lock().unwrap().pop_front();
        match found {
            Some(found) => found,
            None => {
                self.silent_queries.send_modify(|queries| *queries += 1);
                std::future::pending().await
            }
        }
    }

    fn result(&self, skill: &str, name: &str) -> Result<Option<String>, ParameterFault> {
        match name {
            "Width" | "Tool" => Ok(None),
            other => Err(ParameterFault::Unknown {
                skill: skill.to_owned(),
                kind: "result",
                name: other.to_owned(),
                known: vec!["Width".to_owned()],
            }),
        }
    }

    fn connects(&self, _from: (&str, &str), _to: (&str, &str)) -> Result<(), ParameterFault> {
        Ok(())
    }

    fn moves(&self, component: &str, _changer: &str) -> bool {
        self.mover == Some(component)
    }

    async fn read_tools(&self) {
        if let Some(reads) = &self.silent_tools {
            reads.send_modify(|reads| *reads += 1);
            std::future::pending().await
        }
    }

    fn tools(&self) -> ShownTools {
        self.tools.clone()
    }

    fn used_by_others(&self, run: &str) -> BTreeMap<String, String> {
        let mut leases = self.leases.lock().unwrap().clone();
        leases.retain(|_, holder| holder != run);
        leases
    }

    fn lease(&self, run: &str, components: &BTreeSet<String>) -> bool {
        let mut leases = self.leases.lock().unwrap();
        let is_used = |component| leases.get(component).is_some_and(|holder| holder != run);
        if components.iter().any(is_used) {
            return false;
        }
        leases.retain(|_, holder| holder != run);
        let taken = components.iter().map(|one| (one.clone(), run.to_owned()));
        leases.extend(taken);
        self.changed.send_modify(|changes| *changes += 1);
        true
    }

    fn keep(&self, run: &ProcessRun) {
        self.kept.lock().unwrap().push(run.clone());
    }

    fn now(&self) -> u64 {
        self.clock.fetch_add(1, Ordering::Relaxed)
    }
}

struct FakeOpened(Vec<Arc<dyn RunnableSkill>>, Arc<Fakes>);

#[async_trait]
impl Opened for FakeOpened {
    fn skills(&self) -> Vec<Arc<dyn RunnableSkill>> {
        self.0.clone()
    }

    async fn close(self: Box<Self>) {
        self.1.journal.lock().unwrap().push("closed".into());
    }
}

impl FakeSkill {
    /// Returns the results of a run: `Count` has its number.
    fn results(&self, name: &str) -> Vec<(String, SkillValue)> {
        let journal = self.plant.journal.lock().unwrap();
        let runs = journal.iter().filter(|told| **told == name).count();
        let runs = SkillValue::Double(f64::from(u32::try_from(runs).unwrap()));
        match name.rsplit('.').next() {
            Some("Grasp") => vec![("Width".to_owned(), SkillValue::Double(0.03))],
            Some("Count") => vec![("Runs".to_owned(), runs)],
            Some("Find" | "Swap") => vec![("Tool".to_owned(), "urn:example:other".into())],
            _ => vec![],
        }
    }
}

#[async_trait]
impl RunnableSkill for FakeSkill {
    fn name(&self) -> String {
        format!("{}.{}", self.offer.component_name, self.offer.name)
    }

    async fn run(
        &self,
        parameters: Vec<(String, SkillValue)>,
        _within: Duration,
    ) -> Result<RunOutcome, SkillFault> {
        let name = self.name();
        let told = if parameters.is_empty() {
            name.clone()
        } else {
            format!("{name} {}", parameters.len())
        };
        let number = {
            let mut journal = self.plant.journal.lock().unwrap();
            let number = journal.iter().filter(|line| *line != "closed").count();
            journal.push(told);
            number
        };
        if let Some((_, more)) = self.plant.powers.as_ref().filter(|(at, _)| *at == name) {
            let mut offers = self.plant.offers.lock().unwrap();
            offers.extend(more.iter().cloned());
        }
        if let Some(meets) = self
            .plant
            .meets
            .as_ref()
            .filter(|_| name.ends_with(".Meet"))
        {
            let mut halts = self.plant.halts.subscribe();
            tokio::select! {
                _ = meets.wait() => {}
                _ = halts.wait_for(|halts| *halts > 0) => {
                    return Ok(failed("halted by session 3"));
                }
            }
        }
        let mishap = self.plant.mishaps.lock().unwrap().remove(&number);
        let dies = self.plant.dies_at.lock().unwrap().take_if(|at| *at == name);
        match mishap {
            Some(Mishap::Ends(end)) => return end,
            Some(Mishap::Loses(component)) => self.plant.lose(component),
            Some(Mishap::Lost) => {
                self.plant.lose(&self.offer.component);
                std::future::pending::<()>().await;
            }
            None if dies.is_some() => {
                self.plant.lose(&self.offer.component);
                std::future::pending::<()>().await;
            }
            None => {}
        }
        let is_halted = self
            .plant
            .halted_at
            .lock()
            .unwrap()
            .take_if(|at| *at == name)
            .is_some();
        if is_halted {
            self.plant.lose(GRIPPER);
            let mut halts = self.plant.halts.subscribe();
            halts.wait_for(|halts| *halts > 0).await.unwrap();
            return Ok(failed("halted by session 3"));
        }
        if self.plant.fails_at == Some(&*name) {
            return Ok(failed("nothing was gripped"));
        }
        if let Some((_, end)) = self.plant.ends.as_ref().filter(|(at, _)| *at == name) {
            return match end {
                Some(end) => end.clone(),
                None => std::future::pending().await,
            };
        }
        Ok(RunOutcome {
            run: 1,
            succeeded: true,
            unknown: false,
            message: String::new(),
            results: self.results(&name),
            trace: vec![],
        })
    }

    async fn release(&self) -> Result<(), SkillFault> {
        let line = format!("{} released", self.offer.component_name);
        self.plant.journal.lock().unwrap().push(line);
        Ok(())
    }

    async fn halt(&self) -> Result<(), SkillFault> {
        self.plant.halts.send_modify(|halts| *halts += 1);
        Ok(())
    }

    async fn lost(&self) -> String {
        let mut lost = self.plant.lost.subscribe();
        let is_lost = lost
            .wait_for(|lost| lost.contains(&self.offer.component))
            .await
            .is_ok();
        assert!(is_lost, "the plant of the test is gone");
        let spare: Vec<_> = self.plant.spare.lock().unwrap().drain(..).collect();
        if !spare.is_empty() {
            let plant = Arc::clone(&self.plant);
            // Connected a little later, while the process waits.
            tokio::spawn(async move {
                tokio::time::sleep(Duration::from_millis(50)).await;
                plant.offers.lock().unwrap().extend(spare);
                plant.changed.send_modify(|changes| *changes += 1);
            });
        }
        "the connection broke".into()
    }
}

pub(super) fn failed(message: &str) -> RunOutcome {
    RunOutcome {
        run: 1,
        succeeded: false,
        unknown: false,
        message: message.into(),
        results: vec![],
        trace: vec![],
    }
}

/// Returns an outcome whose end is unknown.
pub(super) fn unconfirmed(message: &str) -> RunOutcome {
    RunOutcome {
        unknown: true,
        ..failed(message)
    }
}
