//! Facts about skills for tests of plans.

use super::super::*;
use crate::process::ProcessStep;

/// Facts by which each skill takes all parameters, but those of a component at a step, and has the
/// results whose names begin with its own.
pub(super) struct Known {
    /// A component, and the step whose parameters its skills do not take.
    pub(super) refuses: (&'static str, &'static str),
}

impl Facts for Known {
    fn takes(&self, offer: &Offer, (_, step): (usize, &ProcessStep)) -> Result<(), ParameterFault> {
        match self.refuses == (&*offer.component_name, &*step.name) {
            true => Err(unknown(offer, "parameter", "Nonsense")),
            false => Ok(()),
        }
    }

    fn gives(&self, offer: &Offer, result: &str) -> Result<(), ParameterFault> {
        match result.starts_with(&offer.name) {
            true => Ok(()),
            false => Err(unknown(offer, "result", result)),
        }
    }

    fn connects(&self, from: (&str, &str), to: (&str, &str)) -> Result<(), ParameterFault> {
        match to.1 == "Text" {
            true => Err(ParameterFault::Kind {
                result: from.1.into(),
                has: "a number",
                wanted: "a text",
            }),
            false => Ok(()),
        }
    }
}

fn unknown(offer: &Offer, kind: &'static str, name: &str) -> ParameterFault {
    ParameterFault::Unknown {
        skill: offer.name.clone(),
        kind,
        name: name.to_owned(),
        known: Vec::new(),
    }
}

pub(super) const KNOWN: Known = Known { refuses: ("", "") };

/// Facts by which one robot reaches nothing, one gripper is attached, and the user prefers some.
pub(super) struct Preferring {
    pub(super) attached: &'static str,
    pub(super) prefer: Vec<String>,
}

impl Facts for Preferring {
    fn takes(&self, _: &Offer, _: (usize, &ProcessStep)) -> Result<(), ParameterFault> {
        Ok(())
    }

    fn gives(&self, _: &Offer, _: &str) -> Result<(), ParameterFault> {
        Ok(())
    }

    fn connects(&self, _: (&str, &str), _: (&str, &str)) -> Result<(), ParameterFault> {
        Ok(())
    }

    fn reaches(&self, offer: &Offer, positions: &[[f64; 3]]) -> Result<(), ParameterFault> {
        assert_eq!(positions, [[0.0; 3], [1.0; 3]]);
        let workspace = skills::RobotWorkspace {
            reach: (offer.component_name == "short").then_some(0.5),
            zones: Vec::new(),
        };
        Ok(workspace.allows_all(positions)?)
    }

    fn attachment(&self, offer: &Offer) -> Attachment {
        match offer.component_name == self.attached {
            true => Attachment::AtRobot,
            false => Attachment::None,
        }
    }

    fn prefer(&self) -> &[String] {
        &self.prefer
    }
}

/// Facts by which grippers are attached to robots, given by their names.
pub(super) struct Mounted(pub(super) &'static [(&'static str, &'static str)]);

impl Facts for Mounted {
    fn takes(&self, _: &Offer, _: (usize, &ProcessStep)) -> Result<(), ParameterFault> {
        Ok(())
    }

    fn gives(&self, _: &Offer, _: &str) -> Result<(), ParameterFault> {
        Ok(())
    }

    fn connects(&self, _: (&str, &str), _: (&str, &str)) -> Result<(), ParameterFault> {
        Ok(())
    }

    fn mounts(&self, robot: &Offer, gripper: &Offer) -> Result<(), Unchosen> {
        let pair = (&*robot.component_name, &*gripper.component_name);
        match self.0.contains(&pair) {
            true => Ok(()),
            false => Err(Unchosen::NoTool {
                changer: format!("the changer of {}", pair.0),
            }),
        }
    }

    fn attachment(&self, offer: &Offer) -> Attachment {
        let name = &*offer.component_name;
        match self.0.iter().any(|(robot, _)| *robot == name) {
            true => Attachment::CarriesTool,
            false => Attachment::AtRobot,
        }
    }
}
