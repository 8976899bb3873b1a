//! The Kelvin tool changer: a robot takes tools out of their docks and puts them back by its own
//! motion, and a voltage identifies the locked tool.
//!
//! The changer has no motor: the robot turns its ring by turning the flange in a dock. The changer
//! is therefore a component that runs the skills of a robot, and reads an analog input between two
//! of them.

pub mod simulator;
mod volts;

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use skills::{
    COMPOSITE_HALT_TIMEOUT, Device, Driver, DriverFault, Parameters, PartEnd, PeerAccess, Results,
    Runs, SkillClient, SkillFault, TypeName, Value, Work, run_part,
};
use tokio::time::{Instant, sleep};

pub use self::volts::{Detector, LEVELS, Reading, volts};
use crate::line::Line;
use crate::modbus::Modbus;

/// The installation of the changer.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// The analog converter.
    pub converter: Converter,
    /// The tools and the positions of their docks.
    pub tools: Vec<Tool>,
    /// Time limit of each move of the robot.
    pub within: Duration,
}

/// An analog input by Modbus: an input register in mV.
#[derive(Debug, Clone, PartialEq)]
pub struct Converter {
    /// The line to the converter.
    pub at: Line,
    /// Unit of the converter.
    pub unit: u8,
    /// The input register.
    pub register: u16,
    /// The resistors of the divider between changer and converter: in line, to ground.
    pub divider: (f64, f64),
}

/// The divider of the manufacturer.
pub const DIVIDER: (f64, f64) = (10_000.0, 1_500.0);

/// A tool.
#[derive(Debug, Clone, PartialEq)]
pub struct Tool {
    /// Its number at the changer, from 1 to 10.
    pub number: u8,
    /// The ApplicationUri of its component.
    pub uri: String,
    /// Pose of the flange when the tool is in its dock, before it is locked: m and rad.
    pub dock: [f64; 6],
}

/// The component that moves the flange.
#[derive(Clone)]
pub enum Mover {
    /// A component with PtpMoveSkillType and LinearMoveSkillType.
    Endpoint(String),
    /// Skills of the same program.
    Skills {
        /// PtpMoveSkillType
        ptp: Arc<dyn Runs>,
        /// LinearMoveSkillType
        linear: Arc<dyn Runs>,
    },
}

impl fmt::Debug for Mover {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Endpoint(endpoint) => f.write_str(endpoint),
            Self::Skills { ptp, .. } => f.write_str(&ptp.name()),
        }
    }
}

/// A changer.
#[derive(Debug, Clone)]
pub struct Changer {
    settings: Arc<Settings>,
    converter: Arc<Modbus>,
    mover: Mover,
    peers: PeerAccess,
}

impl Changer {
    /// Creates a changer.
    #[must_use]
    pub fn new(settings: Settings, mover: Mover) -> Self {
        let Converter { at, unit, .. } = &settings.converter;
        Self {
            converter: Arc::new(Modbus::new(at.clone(), *unit)),
            settings: Arc::new(settings),
            mover,
            peers: PeerAccess::default(),
        }
    }
}

impl Device for Changer {
    fn driver(
        &self,
        types: &[TypeName],
        peers: &PeerAccess,
    ) -> Result<Arc<dyn Driver>, DriverFault> {
        let is = |name: &str| types.contains(&TypeName::own(name));
        let what = if is("ChangeToolSkillType") {
            What::Change
        } else if is("AttachToolSkillType") {
            What::Attach
        } else if is("DetachToolSkillType") {
            What::Detach
        } else {
            let own = types.first().map(TypeName::to_string).unwrap_or_default();
            return Err(DriverFault(format!(
                "`kelvin_tool_changer` does the work of ChangeToolSkillType, AttachToolSkillType, DetachToolSkillType and what is \
                 below them, and this is {own}"
            )));
        };
        let changer = Self {
            peers: peers.clone(),
            ..self.clone()
        };
        Ok(Arc::new(Change { changer, what }))
    }
}

/// The action of a skill.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum What {
    Attach,
    Detach,
    Change,
}

#[derive(Debug)]
struct Change {
    changer: Changer,
    what: What,
}

/// A move of the flange: its name, whether it is linear, and its target.
type Way = (&'static str, bool, [f64; 6]);

impl Tool {
    /// Returns a pose beside the dock, with an offset along y and z in m and a rotation in degrees.
    fn beside(&self, (y, z): (f64, f64), degrees: f64) -> [f64; 6] {
        let [at_x, at_y, at_z, a, b, c] = self.dock;
        [at_x, at_y + y, at_z + z, a, b, c + degrees.to_radians()]
    }

    /// Returns the moves to take the tool: from behind into the dock, the ring locked a little too
    /// far and turned back, and out in front.
    fn take(&self) -> [Way; 5] {
        [
            ("BackDoor", false, self.beside((0.0, BACK), 0.0)),
            ("Park", true, self.beside((0.0, 0.0), 0.0)),
            ("Lock", true, self.beside((0.0, 0.0), LOCKED - OVERTURN)),
            ("BackRotate", true, self.beside((0.0, 0.0), LOCKED)),
            ("FrontDoor", true, self.beside((FRONT, 0.0), LOCKED)),
        ]
    }

    /// Returns the moves to put the tool back, in the reverse direction.
    fn put(&self) -> [Way; 6] {
        [
            ("Approach", false, self.beside((FRONT, APPROACH), LOCKED)),
            ("FrontDoor", true, self.beside((FRONT, 0.0), LOCKED)),
            ("Start", true, self.beside((-OVERSHOOT, 0.0), LOCKED)),
            ("Unlock", true, self.beside((-OVERSHOOT, 0.0), UNLOCKED)),
            ("Park", true, self.beside((0.0, 0.0), 0.0)),
            ("BackDoor", true, self.beside((0.0, BACK), 0.0)),
        ]
    }
}

#[async_trait]
impl Driver for Change {
    /// Halt waits for the moves of the robot.
    fn halt_timeout(&self) -> Option<Duration> {
        Some(COMPOSITE_HALT_TIMEOUT)
    }

    fn check(&self, parameters: &Parameters) -> Result<(), String> {
        match self.what {
            What::Detach => Ok(()),
            What::Attach | What::Change => {
                let tool = self.wanted(parameters)?;
                let given = parameters.six("ToolPosition").unwrap_or(tool.dock);
                let apart = tool
                    .dock
                    .iter()
                    .zip(given)
                    .any(|(dock, given)| (dock - given).abs() > TOLERANCE);
                if apart {
                    let dock = Value::from(tool.dock);
                    return Err(format!(
                        "ToolPosition is not where that tool has its dock: {dock}"
                    ));
                }
                Ok(())
            }
        }
    }

    async fn run(&self, work: Work) -> Result<Results, String> {
        let mut look = Look {
            changer: &self.changer,
            detector: Detector::default(),
        };
        let now = look.steady().await?;
        let wanted = match self.what {
            What::Detach => None,
            What::Attach | What::Change => Some(self.wanted(work.parameters())?),
        };
        let attached = match now {
            Reading::Intermediate => {
                return Err(format!(
                    "nothing is moved: {now}, and somebody has to look at it"
                ));
            }
            Reading::Ready | Reading::NoTool => None,
            Reading::Tool(number) => Some(number),
        };
        if attached == wanted.map(|tool| tool.number) {
            return Ok(attached_tool(wanted));
        }
        let put = match (attached, self.what) {
            (Some(number), What::Attach) => {
                return Err(format!(
                    "nothing is moved: tool {number} has to be detached first"
                ));
            }
            (Some(number), What::Change | What::Detach) => Some(self.tool(number)?),
            (None, _) => None,
        };
        let mover = Connected::open(&self.changer.mover, &self.changer.peers).await?;
        let moved = self.moved(&mover, &mut look, (put, wanted), &work).await;
        mover.close().await;
        match moved {
            Ok(()) => Ok(attached_tool(wanted)),
            Err(why) => {
                let now = look
                    .steady()
                    .await
                    .map_or_else(|why| why, |now| now.to_string());
                Err(format!("{why}; {now}"))
            }
        }
    }
}

impl Change {
    fn wanted(&self, parameters: &Parameters) -> Result<&Tool, String> {
        let uri = parameters
            .text("ToolAppUri")
            .ok_or("ToolAppUri is no text")?;
        let mut tools = self.changer.settings.tools.iter();
        tools.find(|tool| tool.uri == uri).ok_or_else(|| {
            let known: Vec<&str> = self
                .changer
                .settings
                .tools
                .iter()
                .map(|tool| tool.uri.as_str())
                .collect();
            format!("ToolAppUri is one of {}", known.join(", "))
        })
    }

    fn tool(&self, number: u8) -> Result<&Tool, String> {
        let mut tools = self.changer.settings.tools.iter();
        tools
            .find(|tool| tool.number == number)
            .ok_or_else(|| format!("nothing is moved: tool {number} is attached, and has no dock"))
    }

    async fn moved(
        &self,
        mover: &Connected,
        look: &mut Look<'_>,
        (put, take): (Option<&Tool>, Option<&Tool>),
        work: &Work,
    ) -> Result<(), String> {
        let within = self.changer.settings.within;
        if let Some(tool) = put {
            mover.go(&tool.put(), within, work).await?;
            work.step("WaitForRelease").await;
            look.until(Reading::NoTool, work).await?;
        }
        if let Some(tool) = take {
            mover.go(&tool.take(), within, work).await?;
            work.step("WaitForTool").await;
            look.until(Reading::Tool(tool.number), work).await?;
            let approach = ("Approach", true, tool.beside((FRONT, APPROACH), LOCKED));
            mover.go(&[approach], within, work).await?;
        }
        Ok(())
    }
}

fn attached_tool(tool: Option<&Tool>) -> Results {
    let uri = tool.map(|tool| tool.uri.as_str()).unwrap_or_default();
    vec![("Tool".to_owned(), uri.into())]
}

/// Reads the voltage.
struct Look<'c> {
    changer: &'c Changer,
    detector: Detector,
}

impl Look<'_> {
    async fn once(&mut self) -> Result<Reading, String> {
        let Converter {
            register,
            divider: (line, ground),
            ..
        } = self.changer.settings.converter;
        let words = self.changer.converter.input(register, 1).await?;
        let millivolts = words.first().copied().unwrap_or_default();
        self.detector
            .feed(f64::from(millivolts) / 1000.0 * (line + ground) / ground)
    }

    /// Returns the reading of two equal consecutive measurements.
    async fn steady(&mut self) -> Result<Reading, String> {
        let mut last = self.once().await?;
        for _ in 0..MOST_LOOKS {
            sleep(POLL).await;
            let now = self.once().await?;
            if now == last {
                return Ok(now);
            }
            last = now;
        }
        Err("the voltage of the tool changer does not come to rest".to_owned())
    }

    async fn until(&mut self, wanted: Reading, work: &Work) -> Result<(), String> {
        let until = Instant::now() + SWITCHED;
        loop {
            let now = self.once().await?;
            if now == wanted || (wanted == Reading::NoTool && now == Reading::Ready) {
                return Ok(());
            }
            if Instant::now() >= until {
                return Err(format!(
                    "the tool changer has not switched within {SWITCHED:?}"
                ));
            }
            tokio::select! {
                () = work.stopped() => return Err("stopped".to_owned()),
                () = sleep(POLL) => {}
            }
        }
    }
}

/// The skills of the robot, and the connection to them.
struct Connected {
    ptp: Arc<dyn Runs>,
    linear: Arc<dyn Runs>,
    client: Option<SkillClient>,
}

impl Connected {
    async fn open(mover: &Mover, peers: &PeerAccess) -> Result<Self, String> {
        let endpoint = match mover {
            Mover::Skills { ptp, linear } => {
                return Ok(Self {
                    ptp: Arc::clone(ptp),
                    linear: Arc::clone(linear),
                    client: None,
                });
            }
            Mover::Endpoint(endpoint) => endpoint,
        };
        let told = |fault: SkillFault| format!("{endpoint}: {fault}");
        let client = peers.connect(endpoint).await?;
        match Self::with(&client).await {
            Ok((ptp, linear)) => Ok(Self {
                ptp,
                linear,
                client: Some(client),
            }),
            Err(fault) => {
                client.close().await;
                Err(told(fault))
            }
        }
    }

    async fn with(client: &SkillClient) -> Result<(Arc<dyn Runs>, Arc<dyn Runs>), SkillFault> {
        let mut both: Vec<Arc<dyn Runs>> = Vec::new();
        for of in ["PtpMoveSkillType", "LinearMoveSkillType"] {
            let found = client.skills_of(&TypeName::own(of)).await?;
            let first = found
                .first()
                .ok_or_else(|| SkillFault::Unexpected(format!("it has no {of}")))?;
            both.push(Arc::new(client.handle(first)));
        }
        let both: [Arc<dyn Runs>; 2] = both
            .try_into()
            .map_err(|_| SkillFault::Unexpected("it has no moves".to_owned()))?;
        let [ptp, linear] = both;
        Ok((ptp, linear))
    }

    async fn go(&self, ways: &[Way], within: Duration, work: &Work) -> Result<(), String> {
        for (step, straight, to) in ways {
            work.step(*step).await;
            let skill = if *straight { &self.linear } else { &self.ptp };
            let parameters = vec![("TargetPosition".to_owned(), Value::from(*to))];
            let outcome = match run_part(&**skill, parameters, within, work, work.stopped()).await {
                PartEnd::Ended(outcome) => outcome,
                PartEnd::Interrupted { halted, .. } => {
                    let halted = halted.err();
                    let why =
                        halted.map(|fault| format!(", and the robot cannot be halted: {fault}"));
                    return Err(format!("stopped at {step}{}", why.unwrap_or_default()));
                }
            };
            let outcome = outcome.map_err(|fault| format!("{step}: {}: {fault}", skill.name()))?;
            if !outcome.succeeded {
                return Err(format!(
                    "{step}: {} failed: {}",
                    skill.name(),
                    outcome.message
                ));
            }
        }
        Ok(())
    }

    async fn close(self) {
        if let Some(client) = self.client {
            client.close().await;
        }
    }
}

/// Offsets for moving into and out of a dock, in m.
const BACK: f64 = 0.045;
const FRONT: f64 = 0.15;
const APPROACH: f64 = 0.1;
const OVERSHOOT: f64 = 0.001;
/// Rotations of the ring, in degrees.
const LOCKED: f64 = -63.0;
const OVERTURN: f64 = 2.0;
const UNLOCKED: f64 = 4.0;
/// Tolerance between a position from a client and the dock, in m or rad.
const TOLERANCE: f64 = 0.005;
const POLL: Duration = Duration::from_millis(100);
const MOST_LOOKS: u32 = 20;
const SWITCHED: Duration = Duration::from_secs(10);

#[cfg(test)]
mod tests;
