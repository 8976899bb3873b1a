//! A simulated tool changer.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use async_trait::async_trait;

use crate::driver::{Driver, RunResults, Work};
use crate::driver_error::{DriverError, InvalidParameter};
use crate::lock::lock;
use crate::parameters::Parameters;
use crate::value::SkillValue;

/// A simulated tool changer. Its drivers share the attached tool.
#[derive(Debug, Clone, Default)]
pub struct Changer {
    tool: Arc<Mutex<String>>,
}

/// A change of the tool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ToolChange {
    /// AttachToolSkillType.
    Attach,
    /// DetachToolSkillType.
    Detach,
    /// ChangeToolSkillType.
    Change,
}

impl Changer {
    /// Returns the driver of a skill; each attach or detach takes the time `takes`.
    #[must_use]
    pub fn driver(&self, change: ToolChange, takes: Duration) -> Arc<dyn Driver> {
        Arc::new(Changing {
            changer: self.clone(),
            change,
            takes,
        })
    }

    /// Returns the ApplicationUri of the attached tool; empty if no tool is attached.
    #[must_use]
    pub fn tool(&self) -> String {
        lock(&self.tool).clone()
    }
}

/// Another tool is attached, with this ApplicationUri.
#[derive(Debug, thiserror::Error)]
#[error("{0} is attached")]
struct ToolAttached(String);

struct Changing {
    changer: Changer,
    change: ToolChange,
    takes: Duration,
}

#[async_trait]
impl Driver for Changing {
    fn can_suspend(&self) -> bool {
        true
    }

    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        let wanted = parameters.text("ToolAppUri");
        if self.change != ToolChange::Detach && wanted.is_none_or(str::is_empty) {
            return Err(InvalidParameter::Unexpected {
                name: "ToolAppUri".to_owned(),
                given: wanted.map(SkillValue::from),
                expected: "is empty".to_owned(),
            });
        }
        Ok(())
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let wanted = work.parameters().text("ToolAppUri").unwrap_or_default();
        let attached = self.changer.tool();
        let ways: &[&str] = match self.change {
            ToolChange::Attach if !attached.is_empty() && attached != wanted => {
                return Err(DriverError::device(ToolAttached(attached)));
            }
            ToolChange::Attach | ToolChange::Change if attached == wanted => &[],
            ToolChange::Change if !attached.is_empty() => &["Detach", "Attach"],
            ToolChange::Attach | ToolChange::Change => &["Attach"],
            ToolChange::Detach if attached.is_empty() => &[],
            ToolChange::Detach => &["Detach"],
        };
        for (done, way) in (1_u8..).zip(ways) {
            work.step(*way).await;
            work.spend(self.takes).await.map_err(|_| {
                let what = way.to_lowercase();
                DriverError::StoppedWith(format!("while the tool is to {what}"))
            })?;
            let now = if *way == "Attach" { wanted } else { "" };
            now.clone_into(&mut lock(&self.changer.tool));
            work.progress(f32::from(done) / if ways.len() > 1 { 2.0 } else { 1.0 });
        }
        Ok(vec![("Tool".to_owned(), self.changer.tool().into())])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conformance;

    const TAKES: Duration = Duration::from_millis(40);

    fn tool(uri: &str) -> Vec<(String, SkillValue)> {
        vec![
            ("ToolPosition".to_owned(), [0.0; 6].into()),
            ("ToolAppUri".to_owned(), uri.into()),
        ]
    }

    #[tokio::test]
    async fn its_driver_is_as_drivers_should_be() {
        let mut tools = ["urn:a", "urn:b", "urn:c"];
        let driver = Changer::default().driver(ToolChange::Change, TAKES);
        let another = || {
            tools.rotate_left(1);
            tool(tools[0])
        };
        conformance::check("ChangeToolSkillType", driver, another)
            .await
            .unwrap();
    }

    #[tokio::test]
    async fn one_tool_at_a_time_is_attached() {
        let changer = Changer::default();
        let run = async |change, of, parameters| {
            let driver = changer.driver(change, TAKES);
            conformance::run_once(of, driver, parameters).await.unwrap()
        };
        let attached = run(ToolChange::Attach, "AttachToolSkillType", tool("urn:a")).await;
        assert_eq!(attached.results, [("Tool".to_owned(), "urn:a".into())]);
        let second = run(ToolChange::Attach, "AttachToolSkillType", tool("urn:b")).await;
        assert_eq!(
            (second.succeeded, second.message.as_str()),
            (false, "urn:a is attached")
        );
        run(ToolChange::Change, "ChangeToolSkillType", tool("urn:b")).await;
        assert_eq!(changer.tool(), "urn:b");
        run(ToolChange::Detach, "DetachToolSkillType", Vec::new()).await;
        assert_eq!(changer.tool(), "");
        let nobody = changer.driver(ToolChange::Attach, TAKES);
        let refused = conformance::run_once("AttachToolSkillType", nobody, tool("")).await;
        assert_eq!(
            refused.unwrap_err().to_string(),
            "BadInvalidArgument: ToolAppUri is empty"
        );
    }
}
