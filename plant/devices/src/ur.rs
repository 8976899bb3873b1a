//! A robot of Universal Robots: programs are sent to its secondary interface, its state is received
//! over RTDE.
//!
//! A run is a program of a few lines. It sets two registers at its beginning and end, so that a
//! program of another client is never mistaken for it. Suspending sets the speed slider to zero,
//! halting brakes along the path.

mod error;
mod follower;
mod force;
mod pose;
mod rtde;
mod script;
pub mod simulator;
mod state;
mod values;
pub mod wire;

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use skills::{
    Device, DeviceValue, Driver, DriverError, DriverFault, InvalidParameter, Measured,
    ParameterType, Parameters, PeerAccess, RunResults, Work,
};
use tokio::io::AsyncWriteExt as _;
use tokio::net::TcpStream;
use tokio::time::{Instant, sleep, timeout, timeout_at};

use self::error::{StopProgram, StoppedRobot, UrError};
pub use self::follower::Follower;
use self::force::ForceGuard;
pub use self::pose::{of_robot, to_robot};
use self::rtde::Rtde;
pub use self::rtde::RtdeError;
use self::state::{INPUTS, OUTPUTS, PAUSED, STOPPED, UnfitRobot, UrState};
use self::wire::RecipeValue;
use crate::modbus::connected;
use crate::skill_types::other_type;

/// The port for programs.
pub const SECONDARY: u16 = 30_002;
/// Reach of a UR5, m.
pub const REACH: f64 = 0.85;

/// Address and reach of a robot.
#[derive(Debug, Clone, PartialEq)]
pub struct UrSettings {
    /// Host and port of RTDE.
    pub rtde: String,
    /// Host and port of the secondary interface.
    pub secondary: String,
    /// Reach, m.
    pub reach: f64,
}

impl UrSettings {
    /// Returns the settings of a host with the default ports.
    #[must_use]
    pub fn of_host(host: &str) -> Self {
        Self {
            rtde: format!("{host}:{}", wire::PORT),
            secondary: format!("{host}:{SECONDARY}"),
            reach: REACH,
        }
    }
}

/// A robot.
#[derive(Debug, Clone)]
pub struct UrRobot {
    settings: Arc<UrSettings>,
}

impl UrRobot {
    /// Creates a robot.
    #[must_use]
    pub fn new(settings: UrSettings) -> Self {
        Self {
            settings: Arc::new(settings),
        }
    }
}

#[async_trait]
impl Device for UrRobot {
    fn driver(
        &self,
        types: &[ParameterType],
        _peers: &PeerAccess,
    ) -> Result<Arc<dyn Driver>, DriverFault> {
        let is = |name: &str| types.contains(&ParameterType::own(name));
        let settings = Arc::clone(&self.settings);
        // ForceMoveSkillType is a subtype of LinearMoveSkillType.
        let kinds = [
            ("PtpMoveSkillType", Kind::Ptp),
            ("ForceMoveSkillType", Kind::Guarded),
            ("LinearMoveSkillType", Kind::Linear),
            ("JointPtpMoveSkillType", Kind::Joints),
        ];
        if let Some((_, kind)) = kinds.into_iter().find(|(name, _)| is(name)) {
            return Ok(Arc::new(Motion { settings, kind }));
        }
        let does = "PtpMoveSkillType, LinearMoveSkillType, ForceMoveSkillType, JointPtpMoveSkillType and what is below them";
        Err(other_type("universal_robot", does, types))
    }

    fn values(&self) -> &'static [DeviceValue] {
        &values::VALUES
    }

    async fn measure(&self, period: Duration, out: &Measured) -> String {
        let why = values::measure(&self.settings.rtde, period, out).await;
        why.to_string()
    }
}

/// A move.
#[derive(Debug)]
struct Motion {
    settings: Arc<UrSettings>,
    kind: Kind,
}

/// The kind of a move.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// From point to point to a pose of the tool.
    Ptp,
    /// Along a straight line of the tool.
    Linear,
    /// Along a straight line that ends at the force of the parameter MaxForce.
    Guarded,
    /// From point to point to positions of the joints.
    Joints,
}

#[async_trait]
impl Driver for Motion {
    fn can_suspend(&self) -> bool {
        true
    }

    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        if self.kind == Kind::Joints {
            return joint_target(parameters).map(drop);
        }
        let [x, y, z, ..] = pose_target(parameters)?;
        let (far, reach) = ((x * x + y * y + z * z).sqrt(), self.settings.reach);
        if far > reach {
            return Err(InvalidParameter::OutOfRange {
                name: TARGET.to_owned(),
                given: format!("{far:.3} m from the base"),
                limit: format!("the robot reaches {reach} m"),
            });
        }
        if self.kind == Kind::Guarded {
            ForceGuard::of(parameters)?;
        }
        match parameters.text("ToolFrame") {
            None | Some("flange") => Ok(()),
            Some(other) => Err(InvalidParameter::Unexpected {
                name: "ToolFrame".to_owned(),
                given: Some(other.into()),
                expected: "is `flange` with this robot".to_owned(),
            }),
        }
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let (mut guard, hertz) = match self.kind {
            Kind::Guarded => (Some(ForceGuard::of(work.parameters())?), GUARDED),
            Kind::Ptp | Kind::Linear | Kind::Joints => (None, HERTZ),
        };
        let mut session = Session::open(&self.settings, hertz).await?;
        let at = session.state().await?;
        at.fit().map_err(UrError::from)?;
        // Differs from the token of the last program of any client.
        let token = at.started.wrapping_add(1) & i32::MAX;
        work.step("Move").await;
        let program = self.program(work.parameters(), token)?;
        let mut sent = Sent {
            token,
            stream: self.send(&program).await?,
        };
        if let Some(guard) = &mut guard {
            guard.zero(at.force);
        }
        let ended = session.follow((self, &work), &mut sent, &mut guard).await?;
        let mut results = match self.kind {
            Kind::Joints => vec![("JointPosition".to_owned(), ended.joints.into())],
            Kind::Ptp | Kind::Linear | Kind::Guarded => {
                vec![("Position".to_owned(), of_robot(ended.pose).into())]
            }
        };
        if let Some(guard) = guard {
            results.extend(guard.results());
        }
        Ok(results)
    }
}

impl Motion {
    fn program(&self, parameters: &Parameters, token: i32) -> Result<String, InvalidParameter> {
        let number = |name: &str| {
            let number = parameters.number(name);
            number.ok_or_else(|| InvalidParameter::missing(name, "number"))
        };
        let line = |target: &str, verb: &str, (a, v): (f64, f64)| {
            format!("{verb}({target}, a={a:.4}, v={v:.4})")
        };
        let move_to = if self.kind == Kind::Joints {
            let target = listed(joint_target(parameters)?);
            let limits = (number("MaxJointAcceleration")?, number("MaxJointVelocity")?);
            line(&format!("[{target}]"), "movej", limits)
        } else {
            let pose = listed(to_robot(pose_target(parameters)?));
            // The speed of a PTP move is that of the joints. At full reach three joints may add up
            // before the tool is too fast.
            let (verb, by) = match self.kind {
                Kind::Linear | Kind::Guarded => ("movel", 1.0),
                Kind::Ptp | Kind::Joints => ("movej", 3.0 * self.settings.reach),
            };
            let limits = (number("MaxAcceleration")? / by, number("MaxVelocity")? / by);
            line(&format!("p[{pose}]"), verb, limits)
        };
        Ok(format!(
            "def ua_skill():\n  write_output_integer_register(24, {token})\n  {move_to}\n  \
             write_output_integer_register(25, {token})\nend\n"
        ))
    }

    /// Returns the program that stops the robot along its path.
    fn stop_program(&self) -> &'static str {
        match self.kind {
            Kind::Joints => HALT_JOINTS,
            Kind::Ptp | Kind::Linear | Kind::Guarded => HALT,
        }
    }

    /// Sends a program. The connection has to stay open until the robot has accepted the program.
    async fn send(&self, program: &str) -> Result<TcpStream, UrError> {
        let address = &self.settings.secondary;
        let unreachable = |error| UrError::Unreachable {
            address: address.clone(),
            error,
        };
        let mut stream = connected(address).await.map_err(unreachable)?;
        match timeout(TAKEN, stream.write_all(program.as_bytes())).await {
            Ok(written) => written.map_err(unreachable)?,
            Err(_) => {
                let address = address.clone();
                return Err(UrError::NotTaken { address });
            }
        }
        Ok(stream)
    }

    /// Stops a robot that moves and whose state is not received. Returns the reason, followed by
    /// the action that was taken.
    async fn lost(&self, work: &Work, why: impl Into<UrError>) -> UrError {
        let stop = match self.send(self.stop_program()).await {
            Ok(program) => {
                sleep(SETTLED).await;
                drop(program);
                StopProgram::Sent
            }
            Err(why) => StopProgram::Failed(Box::new(why)),
        };
        unknown(work, why.into(), stop).await
    }
}

/// Returns the target pose of a move.
fn pose_target(parameters: &Parameters) -> Result<[f64; 6], InvalidParameter> {
    let target = parameters.six(TARGET);
    target.ok_or_else(|| InvalidParameter::missing(TARGET, "six numbers"))
}

/// Returns the target of a joint move, rad.
fn joint_target(parameters: &Parameters) -> Result<[f64; 6], InvalidParameter> {
    let target = parameters.six(JOINT_TARGET);
    let target = target.ok_or_else(|| InvalidParameter::missing(JOINT_TARGET, "six numbers"))?;
    match target.iter().find(|joint| joint.abs() > MOST_TURNED) {
        Some(joint) => Err(InvalidParameter::Unexpected {
            name: JOINT_TARGET.to_owned(),
            given: Some(target.into()),
            expected: format!(
                "has {joint} rad, and the joints turn by {MOST_TURNED:.4} rad to each side"
            ),
        }),
        None => Ok(target),
    }
}

/// Returns six numbers as elements of a list of URScript.
fn listed(numbers: [f64; 6]) -> String {
    numbers.map(|number| format!("{number:.6}")).join(", ")
}

/// Reports that the robot may move. Returns the reason and the action that was taken.
async fn unknown(work: &Work, why: UrError, stop: StopProgram) -> UrError {
    let why = Box::new(why);
    let error = UrError::Unknown { why, stop };
    work.unknown(error.to_string()).await;
    error
}

/// A program that was sent to the robot.
struct Sent {
    /// The value of the registers that the program sets.
    token: i32,
    /// The connection, which stays open until the robot has accepted the program.
    stream: TcpStream,
}

/// The RTDE connection of a run.
struct Session {
    rtde: Rtde,
}

impl Session {
    async fn open(settings: &UrSettings, hertz: f64) -> Result<Self, UrError> {
        let rtde = Rtde::open(&settings.rtde, hertz, &OUTPUTS, &INPUTS).await?;
        Ok(Self { rtde })
    }

    async fn state(&mut self) -> Result<UrState, UrError> {
        let values = self.rtde.next().await?;
        UrState::of(&values).ok_or(UrError::OtherTypes)
    }

    /// Sets the speed slider.
    ///
    /// # Errors
    /// The robot does not receive it and may move: the outcome is unknown.
    async fn slide(
        &mut self,
        (motion, work): (&Motion, &Work),
        fraction: f64,
    ) -> Result<(), UrError> {
        let values = [RecipeValue::U32(1), RecipeValue::F64(fraction)];
        match self.rtde.tell(&values).await {
            Ok(()) => Ok(()),
            Err(why) => Err(motion.lost(work, why).await),
        }
    }

    /// Follows the run until the program is done. No future is dropped on the way: the robot sends
    /// its state often enough to check the run in between.
    async fn follow(
        &mut self,
        (motion, work): (&Motion, &Work),
        sent: &mut Sent,
        guard: &mut Option<ForceGuard>,
    ) -> Result<UrState, UrError> {
        let token = sent.token;
        let asked = Instant::now();
        let mut standing = None;
        loop {
            let at = match self.state().await {
                Ok(at) => at,
                Err(why) => return Err(motion.lost(work, why).await),
            };
            if at.done == token {
                return Ok(at);
            }
            if let Err(why) = at.fit() {
                return Err(self.unfit((motion, work), sent, (&at, why)).await?);
            }
            if let Some(guard) = guard
                && guard.exceeded(at.force, at.pose)
            {
                let force = guard.to_string();
                return self.contact((motion, work), standing, &force).await;
            }
            if at.started == token && at.runtime == STOPPED {
                return Err(UrError::Replaced);
            }
            if at.started != token && asked.elapsed() > TAKEN {
                let why = UrError::NotStarted;
                return Err(self.withdraw((motion, work), sent, why).await?);
            }
            if at.started != token && is(work.stopped()).await {
                let why = UrError::HaltedBefore;
                return Err(self.withdraw((motion, work), sent, why).await?);
            }
            let can_stand = self.rtde.may_tell();
            match (is(work.stopped()).await, is(work.held()).await, standing) {
                (true, _, standing) => {
                    let stopped = self.halt((motion, work), standing).await?;
                    return Err(UrError::Stopped(stopped));
                }
                (false, true, None) if !can_stand => {
                    let stopped = self.halt((motion, work), None).await?;
                    return Err(UrError::SliderTaken { stopped });
                }
                (false, true, None) => {
                    standing = Some(at.slider);
                    self.slide((motion, work), 0.0).await?;
                }
                (false, false, Some(slider)) => {
                    standing = None;
                    self.slide((motion, work), slider).await?;
                }
                (false, true, Some(_)) | (false, false, None) => {}
            }
        }
    }

    /// Ends the run of a robot that stands by itself, as in a protective stop. Such a stop pauses
    /// the program, which goes on when the robot is released: then the outcome is unknown. Returns
    /// the reason.
    ///
    /// # Errors
    /// The robot may go on, or start later: the outcome is unknown.
    async fn unfit(
        &mut self,
        (motion, work): (&Motion, &Work),
        sent: &mut Sent,
        (at, why): (&UrState, UnfitRobot),
    ) -> Result<UrError, UrError> {
        if at.started != sent.token {
            return self.withdraw((motion, work), sent, why.into()).await;
        }
        let program = motion.send(motion.stop_program()).await;
        let until = Instant::now() + BRAKED;
        // The connection is not used after a dropped future.
        while let Ok(Ok(at)) = timeout_at(until, self.state()).await {
            if at.runtime == STOPPED {
                return Ok(why.into());
            }
        }
        let stop = program.map_or(StopProgram::NotSent, |_| StopProgram::Sent);
        let why = Box::new(why.into());
        Err(unknown(work, UrError::MayGoOn { why }, stop).await)
    }

    /// Stops a program that the robot has not started. The stop program follows on the same
    /// connection, so that a robot that accepts the program late stops it at once. Returns the
    /// reason with the position of the robot.
    ///
    /// # Errors
    /// The robot may accept the program later: the outcome is unknown.
    async fn withdraw(
        &mut self,
        (motion, work): (&Motion, &Work),
        sent: &mut Sent,
        why: UrError,
    ) -> Result<UrError, UrError> {
        let stop = motion.stop_program().as_bytes();
        match timeout(BRAKED, sent.stream.write_all(stop)).await {
            Ok(Ok(())) => {}
            Ok(Err(_)) | Err(_) => return Err(unknown(work, why, StopProgram::NotSent).await),
        }
        let until = Instant::now() + BRAKED;
        // The connection is not used after a dropped future.
        while let Ok(Ok(at)) = timeout_at(until, self.state()).await {
            if at.started == sent.token {
                let [x, y, z, ..] = self.stand(work).await?.pose;
                return Ok(UrError::Withdrawn {
                    why: Box::new(why),
                    stopped: StoppedRobot([x, y, z]),
                });
            }
        }
        Err(unknown(work, why, StopProgram::Sent).await)
    }

    /// Brakes at the force limit, and returns the state of the robot after that.
    ///
    /// # Errors
    /// As [`brake`](Self::brake).
    async fn contact(
        &mut self,
        (motion, work): (&Motion, &Work),
        slider: Option<f64>,
        force: &str,
    ) -> Result<UrState, UrError> {
        let braked = self.brake((motion, work), slider).await;
        work.note(force).await;
        braked.map_err(|why| UrError::Contact {
            force: force.to_owned(),
            why: Box::new(why),
        })
    }

    /// Brakes, and returns the position of the robot after that.
    ///
    /// # Errors
    /// As [`brake`](Self::brake).
    async fn halt(
        &mut self,
        of: (&Motion, &Work),
        slider: Option<f64>,
    ) -> Result<StoppedRobot, UrError> {
        let [x, y, z, ..] = self.brake(of, slider).await?.pose;
        Ok(StoppedRobot([x, y, z]))
    }

    /// Brakes, and returns the state of the robot after that. `slider` is the position of the speed
    /// slider before the run was suspended.
    ///
    /// # Errors
    /// The robot may move: the outcome is unknown.
    async fn brake(
        &mut self,
        (motion, work): (&Motion, &Work),
        slider: Option<f64>,
    ) -> Result<UrState, UrError> {
        let _program = match motion.send(motion.stop_program()).await {
            Ok(program) => program,
            Err(why) => return Err(unknown(work, why, StopProgram::NotSent).await),
        };
        let at = self.stand(work).await?;
        let Some(slider) = slider else {
            return Ok(at);
        };
        // With the slider at zero, the robot stands whether or not it has taken the stop program.
        self.slide((motion, work), slider).await?;
        self.stand(work).await
    }

    /// Returns the state of the robot when it stands after the stop program. With a paused program,
    /// it stands whether or not it has taken the stop program, and may go on.
    ///
    /// # Errors
    /// The robot may move: the outcome is unknown.
    async fn stand(&mut self, work: &Work) -> Result<UrState, UrError> {
        let asked = Instant::now();
        loop {
            // The connection is not used after a dropped future.
            let why = match timeout_at(asked + BRAKED, self.state()).await {
                Ok(Ok(at))
                    if asked.elapsed() > SETTLED && at.speed < STILL && at.runtime != PAUSED =>
                {
                    return Ok(at);
                }
                Ok(Ok(_)) => continue,
                Ok(Err(why)) => why,
                Err(_) => UrError::NotStopped,
            };
            return Err(unknown(work, why, StopProgram::Sent).await);
        }
    }
}

/// Returns whether a future is ready now.
async fn is(ready: impl Future<Output = ()>) -> bool {
    tokio::select! {
        biased;
        () = ready => true,
        () = std::future::ready(()) => false,
    }
}

/// The program that stops the robot along its path.
const HALT: &str = "def ua_halt():\n  stopl(3.0)\nend\n";
/// The same for a move of the joints.
const HALT_JOINTS: &str = "def ua_halt():\n  stopj(3.0)\nend\n";
/// Largest position of a joint to each side, rad: a full turn.
const MOST_TURNED: f64 = std::f64::consts::TAU;
/// The parameters with the targets of moves.
const TARGET: &str = "TargetPosition";
const JOINT_TARGET: &str = "TargetJointPosition";
const HERTZ: f64 = 50.0;
/// Rate of the state of a move with a force limit, Hz.
const GUARDED: f64 = 125.0;
const TAKEN: Duration = Duration::from_secs(2);
const SETTLED: Duration = Duration::from_millis(60);
const BRAKED: Duration = Duration::from_millis(700);
/// Below this speed the robot counts as stopped, m/s.
const STILL: f64 = 0.001;

#[cfg(test)]
mod tests;
