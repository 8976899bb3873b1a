//! The plant as the execution of a process needs it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use async_trait::async_trait;
use knowledge::ValueQueryFault;
use skills::choosing::Attachment;
use skills::{RunnableSkill, SkillValue, Unchosen};
use tokio::sync::watch;

use crate::parameter_fault::ParameterFault;
use crate::plan::{Offer, ShownTools};
use crate::process::{GivenParameter, ParameterQuery};
use crate::record::ProcessRun;

/// The plant as the execution of a process needs it.
#[async_trait]
pub(crate) trait Plant: Send + Sync {
    /// Returns the available skills.
    fn offers(&self) -> Vec<Offer>;

    /// Returns a counter that is incremented when the available skills change.
    fn changes(&self) -> watch::Receiver<u64>;

    /// Opens these skills to run them, in the order of the offers. The caller holds the leases of
    /// their components until it calls [`Opened::close`].
    async fn open(&self, offers: &[Offer]) -> Result<Box<dyn Opened>, OpenFault>;

    /// Converts the parameters of a step to the parameters of a skill.
    fn values(
        &self,
        skill: &str,
        given: &[GivenParameter],
    ) -> Result<Vec<(String, SkillValue)>, ParameterFault>;

    /// Evaluates the query of a parameter, which takes up to a second.
    ///
    /// # Errors
    /// The reason why it has no value.
    async fn query(&self, query: &ParameterQuery) -> Result<serde_json::Value, ValueQueryFault>;

    /// Returns the unit of a result of a skill, if it has one.
    ///
    /// # Errors
    /// The reason why the skill does not have the result.
    fn result(&self, skill: &str, name: &str) -> Result<Option<String>, ParameterFault>;

    /// Checks that a result of a skill can be a parameter of another skill.
    fn connects(&self, from: (&str, &str), to: (&str, &str)) -> Result<(), ParameterFault>;

    /// Checks that the robot with a skill reaches positions.
    fn reaches(&self, _skill: &str, _positions: &[[f64; 3]]) -> Result<(), ParameterFault> {
        Ok(())
    }

    /// Returns the attachment of a component, as the tool changers showed last.
    fn attachment(&self, _component: &str) -> Attachment {
        Attachment::None
    }

    /// Returns the tool plate of a gripper in the frame of the flange of a robot, given by their
    /// components, as the tool changers showed last.
    ///
    /// # Errors
    /// The gripper is not at this robot, or it is not known whether it is.
    fn plate(&self, _robot: &str, _gripper: &str) -> Result<[f64; 6], Unchosen> {
        Ok([0.0; 6])
    }

    /// Returns whether a component moves a tool changer, so that it carries the tool.
    fn moves(&self, _component: &str, _changer: &str) -> bool {
        false
    }

    /// Reads the tools of the tool changers.
    async fn read_tools(&self) {}

    /// Returns the tools of the tool changers, as they were read last.
    fn tools(&self) -> ShownTools {
        ShownTools::default()
    }

    /// Returns the components that the user prefers, the most preferred first.
    fn prefer(&self) -> &[String] {
        &[]
    }

    /// Returns the components that other runs use, with these runs.
    fn used_by_others(&self, run: &str) -> BTreeMap<String, String>;

    /// Leases these components to a run, and ends its leases of all other components. Returns
    /// false, and changes nothing, if another run uses one of the components.
    fn lease(&self, run: &str, components: &BTreeSet<String>) -> bool;

    /// Stores the state of a run.
    fn keep(&self, run: &ProcessRun);

    /// Returns the time in ms since 1970.
    fn now(&self) -> u64;
}

/// Skills that can be run.
#[async_trait]
pub(crate) trait Opened: Send + Sync {
    /// Returns the skills in the order in which they were requested.
    fn skills(&self) -> Vec<Arc<dyn RunnableSkill>>;

    /// Releases the leases of the components.
    async fn close(self: Box<Self>);
}

/// The component that could not be opened, and the reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct OpenFault {
    pub(crate) component: String,
    pub(crate) why: String,
}
