//! The parallel gripper 2F-85 of Robotiq, by its registers (Modbus, unit 9 from the factory).
//!
//! Three registers from 1000 on are commands, three from 2000 on are the state: two bytes each, the
//! high byte first.

pub mod simulator;

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use skills::{
    Builtin, Device, DeviceValue, Driver, DriverError, DriverFault, InvalidParameter, Measured,
    ParameterType, Parameters, PeerAccess, RunResults, SkillValue, Work,
};
use tokio::time::{Instant, sleep};

use crate::line::ModbusLine;
use crate::measuring::{ticks, value};
use crate::modbus::{Modbus, ModbusFault};
use crate::skill_types::other_type;

/// Address of the command registers: action, reserved; reserved, position; speed, force.
pub const ACTION: u16 = 0x03E8;
/// Address of the state registers: status, reserved; fault, requested position; position, current.
pub const STATUS: u16 = 0x07D0;
/// The unit number from the factory.
pub const UNIT: u8 = 9;
/// Distance of the fingers at position 0, m.
pub const STROKE: f64 = 0.085;

/// A gripper.
#[derive(Debug, Clone)]
pub struct RobotiqGripper {
    modbus: Arc<Modbus>,
}

impl RobotiqGripper {
    /// Creates a gripper with a unit number behind a line.
    #[must_use]
    pub fn new(line: ModbusLine, unit: u8) -> Self {
        Self {
            modbus: Modbus::shared(&line, unit),
        }
    }
}

#[async_trait]
impl Device for RobotiqGripper {
    fn driver(
        &self,
        types: &[ParameterType],
        _peers: &PeerAccess,
    ) -> Result<Arc<dyn Driver>, DriverFault> {
        let is = |name: &str| types.contains(&ParameterType::own(name));
        let modbus = Arc::clone(&self.modbus);
        let of = |what| -> Arc<dyn Driver> { Arc::new(Motion { modbus, what }) };
        if is("GraspSkillType") {
            return Ok(of(FingerTarget::Close));
        }
        if is("ReleaseSkillType") {
            return Ok(of(FingerTarget::Open));
        }
        if is("MoveGripperSkillType") {
            return Ok(of(FingerTarget::Width));
        }
        let does = "GraspSkillType, ReleaseSkillType, MoveGripperSkillType and what is below them";
        Err(other_type("robotiq_2f85", does, types))
    }

    fn values(&self) -> &'static [DeviceValue] {
        &VALUES
    }

    async fn measure(&self, period: Duration, out: &Measured) -> String {
        let mut ticks = ticks(period);
        loop {
            ticks.tick().await;
            let status = match self.modbus.holding(STATUS, 3).await {
                Ok(words) => Status::of(&words),
                Err(fault) => return fault.to_string(),
            };
            let Some(status) = status else {
                return RobotiqError::NoStatus.to_string();
            };
            out.put(
                "Active",
                Ok((status.active && status.activation == 3).into()),
            );
            out.put("ObjectDetected", Ok(matches!(status.object, 1 | 2).into()));
            out.put("Width", Ok(width(status.position).into()));
            out.put("Current", Ok((f64::from(status.current) * AMPERE).into()));
            out.put("Fault", Ok(SkillValue::Byte(status.fault)));
        }
    }
}

/// The values of a gripper.
const VALUES: [DeviceValue; 5] = [
    value(
        "Active",
        Builtin::Boolean,
        "Whether the gripper is activated.",
    ),
    value(
        "ObjectDetected",
        Builtin::Boolean,
        "Whether the fingers were stopped by an object.",
    ),
    DeviceValue {
        unit: Some("m"),
        range: Some((0.0, STROKE)),
        ..value("Width", Builtin::Double, "The distance of the fingers.")
    },
    DeviceValue {
        unit: Some("A"),
        range: Some((0.0, 2.55)),
        ..value("Current", Builtin::Double, "The current of the motor.")
    },
    value(
        "Fault",
        Builtin::Byte,
        "The fault of the gripper (gFLT); 0 for none.",
    ),
];
/// The unit of the current, A.
const AMPERE: f64 = 0.01;

/// State of the gripper.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Status {
    /// gACT: it was activated.
    active: bool,
    /// gSTA: 0 reset, 1 being activated, 3 activated.
    activation: u8,
    /// gOBJ: 0 moving, 1 stopped by an object while opening, 2 while closing, 3 at the position.
    object: u8,
    /// gFLT
    fault: u8,
    /// gPR: the requested position, as received by the gripper.
    wanted: u8,
    /// gPO: from 0, open, to 255, closed.
    position: u8,
    /// gCU: the current in 10 mA.
    current: u8,
}

impl Status {
    fn of(words: &[u16]) -> Option<Self> {
        let [status, fault, position] = words else {
            return None;
        };
        let [status, _reserved] = status.to_be_bytes();
        let [fault, wanted] = fault.to_be_bytes();
        let [position, current] = position.to_be_bytes();
        Some(Self {
            active: status & 1 == 1,
            activation: status >> 4 & 3,
            object: status >> 6,
            fault: fault & 0x0F,
            wanted,
            position,
            current,
        })
    }

    /// Returns the description of a fault that prevents a motion.
    fn broken(self) -> Option<&'static str> {
        match self.fault {
            0x05 => Some("it has to be activated first"),
            0x07 => Some("it was not activated"),
            0x08 => Some("it is too hot"),
            0x0A => Some("its voltage is too low"),
            0x0B => Some("it is being released automatically"),
            0x0C => Some("a fault inside it"),
            0x0D => Some("its activation failed"),
            0x0E => Some("its current is too high"),
            0x0F => Some("it was released automatically, and has to be activated anew"),
            _ => None,
        }
    }
}

/// The reason why a motion of the fingers is not done.
#[derive(Debug, thiserror::Error)]
enum RobotiqError {
    #[error(transparent)]
    Modbus(#[from] ModbusFault),
    #[error("the gripper answers without its status")]
    NoStatus,
    #[error("nothing is between the fingers")]
    NothingGrasped,
    #[error("something stops the fingers at position {position} while they open")]
    Blocked { position: u8 },
    #[error("the gripper cannot be activated: {why}")]
    NotActivated { why: &'static str },
    #[error("the gripper is not activated within {:?}", ACTIVATION)]
    SlowActivation,
    #[error("the gripper has lost its activation while it moved: was it switched off?")]
    LostActivation,
    #[error("the gripper stopped: {why}")]
    Broken { why: &'static str },
    #[error("the fingers do not come to a stand within {:?}", MOTION)]
    NotAtRest,
    #[error("stopped while it was being activated")]
    StoppedInActivation,
    #[error("stopped with the fingers at position {position} of 255")]
    Stopped { position: u8 },
}

impl From<RobotiqError> for DriverError {
    fn from(error: RobotiqError) -> Self {
        Self::device(error)
    }
}

/// A motion that opens or closes the gripper.
#[derive(Debug)]
struct Motion {
    modbus: Arc<Modbus>,
    what: FingerTarget,
}

/// Target of the fingers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FingerTarget {
    Close,
    Open,
    /// The distance of the parameter Width.
    Width,
}

/// Target position, speed and force.
#[derive(Debug, Clone, Copy)]
struct Goal {
    position: u8,
    speed: u8,
    force: u8,
}

#[async_trait]
impl Driver for Motion {
    fn can_suspend(&self) -> bool {
        true
    }

    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        match parameters.number("Width") {
            Some(width) if self.what == FingerTarget::Width && width > STROKE => {
                Err(InvalidParameter::OutOfRange {
                    name: "Width".to_owned(),
                    given: format!("{width} m"),
                    limit: format!("the fingers open {STROKE} m"),
                })
            }
            _ => Ok(()),
        }
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        self.activate(&work).await?;
        let (step, position) = match self.what {
            FingerTarget::Close => ("Close", 255),
            FingerTarget::Open => ("Open", 0),
            FingerTarget::Width => ("Move", position(work.parameters())),
        };
        work.step(step).await;
        let goal = Goal {
            position,
            speed: 255,
            force: force(work.parameters()),
        };
        let ended = self.go(goal, &work).await?;
        match (self.what, ended.object) {
            (FingerTarget::Close, 2) => Ok(vec![("Gripped".to_owned(), true.into())]),
            (FingerTarget::Close, _) => Err(RobotiqError::NothingGrasped.into()),
            (FingerTarget::Open, 1) => {
                let position = ended.position;
                Err(RobotiqError::Blocked { position }.into())
            }
            (FingerTarget::Open, _) => Ok(Vec::new()),
            (FingerTarget::Width, object) => Ok(vec![
                ("Width".to_owned(), width(ended.position).into()),
                ("Gripped".to_owned(), (object != 3).into()),
            ]),
        }
    }
}

impl Motion {
    async fn status(&self) -> Result<Status, RobotiqError> {
        let words = self.modbus.holding(STATUS, 3).await?;
        Status::of(&words).ok_or(RobotiqError::NoStatus)
    }

    async fn act(&self, action: u8, goal: Goal) -> Result<(), ModbusFault> {
        let words = [
            u16::from_be_bytes([action, 0]),
            u16::from_be_bytes([0, goal.position]),
            u16::from_be_bytes([goal.speed, goal.force]),
        ];
        self.modbus.write(ACTION, &words).await
    }

    /// Activates the gripper if it is not active: after power-on, or after a fault that only a new
    /// activation clears.
    async fn activate(&self, work: &Work) -> Result<(), RobotiqError> {
        let still = Goal {
            position: 0,
            speed: 0,
            force: 0,
        };
        let status = self.status().await?;
        if status.active && status.activation == 3 && status.broken().is_none() {
            return Ok(());
        }
        work.step("Activate").await;
        self.act(RESET, still).await?;
        self.act(ACTIVATE, still).await?;
        let until = Instant::now() + ACTIVATION;
        loop {
            tokio::select! {
                () = work.stopped() => return Err(RobotiqError::StoppedInActivation),
                () = sleep(POLL) => {}
            }
            let status = self.status().await?;
            if status.activation == 3 {
                return Ok(());
            }
            if let (0x0A.., Some(why)) = (status.fault, status.broken()) {
                return Err(RobotiqError::NotActivated { why });
            }
            if Instant::now() >= until {
                return Err(RobotiqError::SlowActivation);
            }
        }
    }

    /// Moves the fingers until they stop.
    async fn go(&self, goal: Goal, work: &Work) -> Result<Status, RobotiqError> {
        let from = self.status().await?.position;
        self.act(GO, goal).await?;
        let mut until = Instant::now() + MOTION;
        loop {
            tokio::select! {
                () = work.held() => {
                    self.act(ACTIVATE, goal).await?;
                    if work.going().await.is_err() {
                        let position = self.status().await?.position;
                        return Err(RobotiqError::Stopped { position });
                    }
                    self.act(GO, goal).await?;
                    until = Instant::now() + MOTION;
                }
                () = sleep(POLL) => {}
            }
            let status = self.status().await?;
            if !status.active || status.activation != 3 {
                return Err(RobotiqError::LostActivation);
            }
            if let Some(why) = status.broken() {
                return Err(RobotiqError::Broken { why });
            }
            if status.wanted == goal.position && status.object != 0 {
                return Ok(status);
            }
            work.progress(share(from, status.position, goal.position));
            if Instant::now() >= until {
                return Err(RobotiqError::NotAtRest);
            }
        }
    }
}

/// Converts the force of a run in N to the gripper's unit: 0 is 20 N, 255 is 235 N.
fn force(parameters: &Parameters) -> u8 {
    let newton = parameters.number("Force").unwrap_or(WEAKEST);
    let share = ((newton - WEAKEST) / (STRONGEST - WEAKEST)).clamp(0.0, 1.0);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "from 0 to 255"
    )]
    let force = (share * 255.0).round() as u8;
    force
}

/// Returns the position for the finger distance of the parameter Width.
fn position(parameters: &Parameters) -> u8 {
    let apart = parameters.number("Width").unwrap_or(STROKE);
    let closed = (1.0 - apart / STROKE).clamp(0.0, 1.0);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "from 0 to 255"
    )]
    let position = (closed * 255.0).round() as u8;
    position
}

/// Returns the finger distance of a position, m.
fn width(position: u8) -> f64 {
    (1.0 - f64::from(position) / 255.0) * STROKE
}

fn share(from: u8, at: u8, to: u8) -> f32 {
    let whole = f32::from(from.abs_diff(to));
    if whole > 0.0 {
        f32::from(from.abs_diff(at)) / whole
    } else {
        1.0
    }
}

const RESET: u8 = 0x00;
/// rACT
const ACTIVATE: u8 = 0x01;
/// rACT and rGTO
const GO: u8 = 0x09;
const WEAKEST: f64 = 20.0;
const STRONGEST: f64 = 235.0;
const POLL: Duration = Duration::from_millis(20);
const ACTIVATION: Duration = Duration::from_secs(10);
const MOTION: Duration = Duration::from_secs(10);

#[cfg(test)]
mod tests;
