//! The positions that a robot reaches: its reach and its zones.

use std::sync::Arc;

use async_trait::async_trait;

use crate::driver::{Driver, RunResults, Work};
use crate::driver_error::{DriverError, InvalidParameter};
use crate::out_of_workspace::OutOfWorkspace;
use crate::parameters::{Parameters, SkillParameter};
use crate::value::SkillValue;

/// The positions that a robot reaches.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RobotWorkspace {
    /// The largest distance from the base, m; `None` for no limit.
    pub reach: Option<f64>,
    /// The zones of the robot; empty for no limit.
    pub zones: Vec<Zone>,
}

/// A part of the cell that a robot may move to.
#[derive(Debug, Clone, PartialEq)]
pub struct Zone {
    /// The name.
    pub name: String,
    /// The smallest x, y and z in the frame of the base, m.
    pub low: [f64; 3],
    /// The largest x, y and z.
    pub high: [f64; 3],
}

impl RobotWorkspace {
    /// Checks that a position is within the reach and in a zone.
    ///
    /// # Errors
    /// [`OutOfWorkspace`].
    pub fn allows(&self, position: [f64; 3]) -> Result<(), OutOfWorkspace> {
        let [x, y, z] = position;
        let far = (x * x + y * y + z * z).sqrt();
        if let Some(reach) = self.reach.filter(|reach| far > *reach) {
            return Err(OutOfWorkspace::Reach {
                position,
                far,
                reach,
            });
        }
        let is_in = |zone: &Zone| {
            let bounds = zone.low.iter().zip(zone.high);
            position
                .iter()
                .zip(bounds)
                .all(|(at, (low, high))| (*low..=high).contains(at))
        };
        if self.zones.is_empty() || self.zones.iter().any(is_in) {
            return Ok(());
        }
        let zones = self.zones.iter().map(|zone| zone.name.clone()).collect();
        Err(OutOfWorkspace::Zones { position, zones })
    }

    /// Checks that all positions are within the reach and in a zone.
    ///
    /// # Errors
    /// The reason why the robot does not go to the first of the others.
    pub fn allows_all(&self, positions: &[[f64; 3]]) -> Result<(), OutOfWorkspace> {
        positions.iter().try_for_each(|at| self.allows(*at))
    }

    /// Checks the target of a move among the parameters of a skill.
    ///
    /// # Errors
    /// [`InvalidParameter::OutOfWorkspace`].
    pub fn allows_target<'p>(
        &self,
        mut parameters: impl Iterator<Item = &'p (String, SkillValue)>,
    ) -> Result<(), InvalidParameter> {
        let target = parameters.find(|(name, _)| name == TARGET);
        let target = target.and_then(|(_, value)| value.as_f64s());
        match target.as_deref() {
            Some([x, y, z, ..]) => {
                let allowed = self.allows([*x, *y, *z]);
                allowed.map_err(|why| InvalidParameter::OutOfWorkspace {
                    name: TARGET.to_owned(),
                    why,
                })
            }
            Some(_) | None => Ok(()),
        }
    }

    /// Returns the lower and upper bounds of all zones, six numbers each.
    pub(crate) fn bounds(&self) -> Vec<f64> {
        let bounds = self.zones.iter().flat_map(|zone| [zone.low, zone.high]);
        bounds.flatten().collect()
    }

    /// Returns the workspace with these zones, as [`bounds`](Self::bounds) returns their bounds.
    pub(crate) fn of(reach: Option<f64>, names: Vec<String>, bounds: &[f64]) -> Self {
        let zones = names.into_iter().zip(bounds.chunks(6));
        let zones = zones.filter_map(|(name, bounds)| {
            let [low_x, low_y, low_z, high_x, high_y, high_z] = *bounds else {
                return None;
            };
            Some(Zone {
                name,
                low: [low_x, low_y, low_z],
                high: [high_x, high_y, high_z],
            })
        });
        Self {
            reach,
            zones: zones.collect(),
        }
    }

    /// Returns the driver, which refuses targets outside of the workspace.
    pub(crate) fn bounded(self: &Arc<Self>, driver: Arc<dyn Driver>) -> Arc<dyn Driver> {
        Arc::new(Bounded {
            workspace: Arc::clone(self),
            driver,
        })
    }
}

/// A driver of moves within a workspace.
struct Bounded {
    workspace: Arc<RobotWorkspace>,
    driver: Arc<dyn Driver>,
}

#[async_trait]
impl Driver for Bounded {
    fn can_suspend(&self) -> bool {
        self.driver.can_suspend()
    }

    fn halt_timeout(&self) -> Option<std::time::Duration> {
        self.driver.halt_timeout()
    }

    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        self.workspace.allows_target(parameters.all().iter())?;
        self.driver.check(parameters)
    }

    fn prepared(
        &self,
        declared: &[SkillParameter],
        given: Vec<(String, SkillValue)>,
    ) -> Vec<(String, SkillValue)> {
        self.driver.prepared(declared, given)
    }

    fn uses(&self) -> Vec<String> {
        self.driver.uses()
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        self.driver.run(work).await
    }
}

/// The parameter of a move with its target.
const TARGET: &str = "TargetPosition";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_position_is_within_the_reach_and_in_a_zone() {
        let zone = |name: &str, low, high| Zone {
            name: name.to_owned(),
            low,
            high,
        };
        let workspace = RobotWorkspace {
            reach: Some(1.0),
            zones: vec![
                zone("table", [0.2, -0.5, 0.0], [0.8, 0.5, 0.4]),
                zone("rack", [-0.8, -0.1, 0.0], [-0.5, 0.1, 1.0]),
            ],
        };
        let names = workspace.zones.iter().map(|zone| zone.name.clone());
        let read = RobotWorkspace::of(Some(1.0), names.collect(), &workspace.bounds());
        assert_eq!(read, workspace);
        for (position, expected) in [
            ([0.4, 0.2, 0.1], ""),
            ([-0.6, 0.0, 0.5], ""),
            (
                [0.0, 0.0, 0.2],
                "0.000, 0.000, 0.200 m is in none of its zones: table, rack",
            ),
            (
                [0.8, 0.5, 0.4],
                "is 1.025 m from its base, and it reaches 1 m",
            ),
        ] {
            let why = workspace.allows(position).err();
            let why = why.map(|why| why.to_string()).unwrap_or_default();
            assert!(
                why.ends_with(expected) && why.is_empty() == expected.is_empty(),
                "{why}"
            );
        }
        let target = [("TargetPosition".to_owned(), SkillValue::from([2.0; 6]))];
        let why = workspace.allows_target(target.iter()).unwrap_err();
        assert!(why.to_string().starts_with("TargetPosition: "), "{why}");
        assert_eq!(RobotWorkspace::default().allows([9.0, 0.0, 0.0]), Ok(()));
    }
}
