//! The vacuum gripper ECBPi of Schmalz behind an IO-Link master, by the JSON interface of IO-Link
//! over HTTP.
//!
//! Process data in, 4 bytes: bit 0 part present, 1 vacuum in the range of control, 5 part detached,
//! 6 and 7 state of the device. Two values follow. The second value, the vacuum in mbar, has two
//! bytes, the high byte first. Process data out, 2 bytes: bit 0 vacuum, bit 1 blow off.

pub mod simulator;

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use serde_json::{Value, json};
use skills::{
    Builtin, Device, DeviceValue, Driver, DriverError, DriverFault, Measured, ParameterType,
    PeerAccess, RunResults, Work,
};
use tokio::time::{Instant, sleep};

use crate::http::{DeviceHost, DeviceRequest, HttpFault};
use crate::measuring::{ticks, value};
use crate::skill_types::other_type;

/// A gripper.
#[derive(Debug, Clone)]
pub struct SchmalzGripper {
    port: Arc<IoLinkPort>,
    timing: SchmalzTiming,
}

/// Time limits of the gripper.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SchmalzTiming {
    /// Time limit for holding a part.
    pub grasp: Duration,
    /// Time limit for releasing a part.
    pub release: Duration,
}

impl Default for SchmalzTiming {
    fn default() -> Self {
        Self {
            grasp: Duration::from_secs(8),
            release: Duration::from_secs(2),
        }
    }
}

impl SchmalzGripper {
    /// Creates the device of an alias, such as `master1port1`, at the master at `host:port`.
    #[must_use]
    pub fn new(master: &str, alias: &str, timing: SchmalzTiming) -> Self {
        Self {
            port: Arc::new(IoLinkPort::new(master, alias)),
            timing,
        }
    }
}

#[async_trait]
impl Device for SchmalzGripper {
    fn driver(
        &self,
        types: &[ParameterType],
        _peers: &PeerAccess,
    ) -> Result<Arc<dyn Driver>, DriverFault> {
        let is = |name: &str| types.contains(&ParameterType::own(name));
        let motion = |holds| -> Arc<dyn Driver> {
            Arc::new(Motion {
                port: Arc::clone(&self.port),
                timing: self.timing,
                holds,
            })
        };
        if is("GraspSkillType") {
            return Ok(motion(true));
        }
        if is("ReleaseSkillType") {
            return Ok(motion(false));
        }
        let does = "GraspSkillType, ReleaseSkillType and what is below them";
        Err(other_type("schmalz_ecbpi", does, types))
    }

    fn values(&self) -> &'static [DeviceValue] {
        &VALUES
    }

    async fn measure(&self, period: Duration, out: &Measured) -> String {
        let mut ticks = ticks(period);
        loop {
            ticks.tick().await;
            let status = match self.port.status().await {
                Ok(status) => status,
                Err(why) => return why.to_string(),
            };
            out.put("PartPresent", Ok(status.part_present.into()));
            out.put("InControlRange", Ok(status.in_control_range.into()));
            out.put("PartDetached", Ok(status.part_detached.into()));
            out.put("Vacuum", Ok(skills::SkillValue::UInt16(status.vacuum)));
            out.put("Health", Ok(skills::SkillValue::Byte(status.health)));
        }
    }
}

/// The values of a gripper.
const VALUES: [DeviceValue; 5] = [
    value(
        "PartPresent",
        Builtin::Boolean,
        "Whether the vacuum holds a part.",
    ),
    value(
        "InControlRange",
        Builtin::Boolean,
        "Whether the vacuum is in the range of control.",
    ),
    value(
        "PartDetached",
        Builtin::Boolean,
        "Whether the part was blown off.",
    ),
    DeviceValue {
        unit: Some("mbar"),
        range: Some((0.0, 1000.0)),
        ..value("Vacuum", Builtin::UInt16, "The vacuum at the cups.")
    },
    value(
        "Health",
        Builtin::Byte,
        "0 works, 1 works with warnings, 2 with severe warnings, 3 does not work.",
    ),
];

/// The reason why a gripper has no state, or has not done its work.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SchmalzError {
    #[error(transparent)]
    Http(#[from] HttpFault),
    #[error("the answer of {master} is damaged: {why}")]
    Damaged { master: String, why: &'static str },
    #[error("{master} says that the data of {alias} are not valid")]
    NotValid { master: String, alias: String },
    #[error("stopped, and the vacuum is switched off")]
    Stopped,
    #[error("the gripper says that it does not work properly")]
    Broken,
    #[error(
        "no part is held after {within:?}: the vacuum is {vacuum} mbar, {}in the range of control",
        if *in_control_range { "" } else { "not " }
    )]
    NotHeld {
        within: Duration,
        /// mbar
        vacuum: u16,
        in_control_range: bool,
    },
    #[error("the part is still there after {within:?}")]
    NotReleased { within: Duration },
}

impl From<SchmalzError> for DriverError {
    fn from(error: SchmalzError) -> Self {
        Self::device(error)
    }
}

/// A port of a master.
#[derive(Debug)]
pub(crate) struct IoLinkPort {
    master: DeviceHost,
    alias: String,
}

/// State of the gripper.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Status {
    part_present: bool,
    in_control_range: bool,
    part_detached: bool,
    /// 0 works, 1 works with warnings, 2 with severe warnings, 3 does not work.
    health: u8,
    /// mbar
    vacuum: u16,
}

impl fmt::Display for IoLinkPort {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} at {}", self.alias, self.master)
    }
}

impl Status {
    fn of(bytes: &[u8]) -> Option<Self> {
        let [flags, _power, high, low] = bytes else {
            return None;
        };
        Some(Self {
            part_present: flags & 1 != 0,
            in_control_range: flags >> 1 & 1 != 0,
            part_detached: flags >> 5 & 1 != 0,
            health: flags >> 6,
            vacuum: u16::from_be_bytes([*high, *low]),
        })
    }
}

impl IoLinkPort {
    /// Creates the port of an alias at the master at `host:port`.
    pub(crate) fn new(master: &str, alias: &str) -> Self {
        Self {
            master: DeviceHost::plain(master.to_owned()),
            alias: alias.to_owned(),
        }
    }

    async fn status(&self) -> Result<Status, SchmalzError> {
        let bytes = self.process_data().await?;
        let status = Status::of(&bytes);
        status.ok_or_else(|| self.damaged("the process data are not four bytes"))
    }

    /// Returns the process data of the device at the port.
    pub(crate) async fn process_data(&self) -> Result<Vec<u8>, SchmalzError> {
        let path = format!(
            "{}/{}/processdata/getdata/value?format=byteArray",
            DEVICES, self.alias
        );
        let answer = self.ask("GET", &path, None).await?;
        // Both spellings are in use.
        let data = answer.get("ioLink").or_else(|| answer.get("iolink"));
        let data = data.ok_or_else(|| self.damaged("it has no process data"))?;
        if data.get("valid").and_then(Value::as_bool) == Some(false) {
            return Err(SchmalzError::NotValid {
                master: self.master.to_string(),
                alias: self.alias.clone(),
            });
        }
        let bytes: Option<Vec<u8>> =
            data.get("value")
                .and_then(Value::as_array)
                .and_then(|bytes| {
                    bytes
                        .iter()
                        .map(|byte| byte.as_u64().and_then(|byte| byte.try_into().ok()))
                        .collect()
                });
        bytes.ok_or_else(|| self.damaged("the process data are not bytes"))
    }

    async fn set(&self, out: u8) -> Result<(), HttpFault> {
        let path = format!("{}/{}/processdata/value", DEVICES, self.alias);
        let data = json!({"ioLink": {"valid": true, "value": [out, 0]}});
        self.ask("POST", &path, Some(&data)).await.map(drop)
    }

    async fn ask(
        &self,
        method: &str,
        path: &str,
        body: Option<&Value>,
    ) -> Result<Value, HttpFault> {
        let asked = DeviceRequest {
            method,
            path,
            body,
            within: ANSWER,
        };
        self.master.ask(asked).await
    }

    fn damaged(&self, why: &'static str) -> SchmalzError {
        SchmalzError::Damaged {
            master: self.master.to_string(),
            why,
        }
    }
}

/// Grasping or releasing a part.
#[derive(Debug)]
struct Motion {
    port: Arc<IoLinkPort>,
    timing: SchmalzTiming,
    holds: bool,
}

#[async_trait]
impl Driver for Motion {
    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let (step, out) = if self.holds {
            ("Suck", VACUUM)
        } else {
            ("BlowOff", BLOW_OFF)
        };
        work.step(step).await;
        self.port.set(out).await.map_err(SchmalzError::from)?;
        let waited = self.wait(&work).await;
        match (self.holds, waited) {
            (true, Ok(())) => Ok(vec![("Gripped".to_owned(), true.into())]),
            (_, waited) => {
                // The vacuum is switched off if no part is held, and so is the air after blowing.
                let off = self.port.set(0).await;
                waited?;
                off.map_err(SchmalzError::from)?;
                Ok(Vec::new())
            }
        }
    }
}

impl Motion {
    async fn wait(&self, work: &Work) -> Result<(), SchmalzError> {
        let within = if self.holds {
            self.timing.grasp
        } else {
            self.timing.release
        };
        let began = Instant::now();
        loop {
            tokio::select! {
                () = work.stopped() => return Err(SchmalzError::Stopped),
                () = sleep(POLL) => {}
            }
            let status = self.port.status().await?;
            if status.health == 3 {
                return Err(SchmalzError::Broken);
            }
            let done = match self.holds {
                true => status.part_present,
                false => !status.part_present && (status.part_detached || status.vacuum < DETACHED),
            };
            if done && began.elapsed() >= SETTLED {
                return Ok(());
            }
            work.progress(began.elapsed().as_secs_f32() / within.as_secs_f32());
            if began.elapsed() >= within {
                return Err(match self.holds {
                    true => SchmalzError::NotHeld {
                        within,
                        vacuum: status.vacuum,
                        in_control_range: status.in_control_range,
                    },
                    false => SchmalzError::NotReleased { within },
                });
            }
        }
    }
}

/// Halt leaves a driver a second, enough for two requests.
const ANSWER: Duration = Duration::from_millis(400);
const DEVICES: &str = "/iolink/v1/devices";
const VACUUM: u8 = 1;
const BLOW_OFF: u8 = 2;
/// A lower vacuum holds no part, mbar.
const DETACHED: u16 = 10;
const POLL: Duration = Duration::from_millis(20);
/// Process data may contain the state before the request until a cycle of IO-Link and a cycle of
/// the master have passed.
const SETTLED: Duration = Duration::from_millis(30);

#[cfg(test)]
mod tests;
