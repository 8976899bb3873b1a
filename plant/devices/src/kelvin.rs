//! The Kelvin tool changer: a robot takes tools out of their docks and puts them back by its own
//! motion, and a voltage identifies the locked tool.
//!
//! The changer has no motor: the robot turns its ring by turning the flange in a dock. The changer
//! is therefore a component that runs the skills of a robot, and reads an analog input between two
//! of them.

mod error;
mod look;
mod mover;
pub mod simulator;
mod volts;

use std::collections::BTreeMap;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use async_trait::async_trait;
use skills::frame::Frame;
use skills::{
    Builtin, COMPOSITE_HALT_TIMEOUT, Chosen, Device, DeviceValue, Driver, DriverError, DriverFault,
    InvalidParameter, Measured, ParameterType, Parameters, Partner, PartnerError, PeerAccess,
    RunResults, RunnableSkill, SkillFault, SkillValue, ToolState, UnknownValue, Work,
};
use tokio::sync::watch;
use tokio::time::{Instant, sleep, timeout};

use self::error::KelvinError;
use self::look::Look;
use self::mover::ConnectedMover;
pub use self::volts::{ChangerReading, InvalidVoltage, LEVELS, VoltageDetector, volts};
use crate::line::ModbusLine;
use crate::measuring::{ticks, value};
use crate::modbus::Modbus;
use crate::skill_types::other_type;

/// The installation of the changer.
#[derive(Debug, Clone, PartialEq)]
pub struct KelvinSettings {
    /// The analog converter.
    pub converter: Converter,
    /// The tools and the positions of their docks.
    pub tools: Vec<Tool>,
    /// The pose of the tool plate in the frame of the flange.
    pub plate: [f64; 6],
    /// Time limit of each move of the robot.
    pub within: Duration,
    /// Time limit for the component of a locked tool to become ready.
    pub ready_within: Duration,
}

/// The tool plate of the manufacturer's changer.
pub const PLATE: [f64; 6] = [0.0, 0.0, 0.047, 0.0, 0.0, 0.0];
/// Default time limit for the component of a locked tool.
pub const READY_WITHIN: Duration = Duration::from_secs(60);

/// An analog input by Modbus: an input register in mV.
#[derive(Debug, Clone, PartialEq)]
pub struct Converter {
    /// The line to the converter.
    pub at: ModbusLine,
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
    /// Pose of the flange when the tool is in its dock, before it is locked: m and rad. It counts
    /// for requests without a ToolPosition until the tool is put elsewhere.
    pub dock: [f64; 6],
}

/// The component that moves the flange.
#[derive(Clone)]
pub enum Mover {
    /// A component with PtpMoveSkillType and LinearMoveSkillType; `None` for the only one that is
    /// found.
    Component(Option<Partner>),
    /// Skills of the same program.
    Skills {
        /// PtpMoveSkillType
        ptp: Arc<dyn RunnableSkill>,
        /// LinearMoveSkillType
        linear: Arc<dyn RunnableSkill>,
    },
}

impl fmt::Debug for Mover {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Component(Some(partner)) => write!(f, "{partner}"),
            Self::Component(None) => f.write_str("any"),
            Self::Skills { ptp, .. } => f.write_str(&ptp.name()),
        }
    }
}

/// A changer.
#[derive(Debug, Clone)]
pub struct KelvinChanger {
    settings: Arc<KelvinSettings>,
    converter: Arc<Modbus>,
    mover: Mover,
    peers: PeerAccess,
    /// The state for clients.
    shown: Arc<watch::Sender<ToolState>>,
    /// Where each tool was put last, by its number.
    docks: Arc<Mutex<BTreeMap<u8, [f64; 6]>>>,
}

impl KelvinChanger {
    /// Creates a changer.
    #[must_use]
    pub fn new(settings: KelvinSettings, mover: Mover) -> Self {
        let Converter { at, unit, .. } = &settings.converter;
        Self {
            converter: Modbus::shared(at, *unit),
            shown: Arc::new(watch::channel(shown_at_first(&settings, &mover)).0),
            docks: Arc::default(),
            settings: Arc::new(settings),
            mover,
            peers: PeerAccess::default(),
        }
    }

    fn look(&self) -> Look {
        Look::new(&self.settings.converter, &self.converter)
    }

    /// Shows a reading to clients; `None` if there is none.
    fn show(&self, reading: Option<ChangerReading>) {
        let current = match reading {
            Some(ChangerReading::Ready | ChangerReading::NoTool) => Some(String::new()),
            Some(ChangerReading::Tool(number)) => {
                let mut tools = self.settings.tools.iter();
                let known = tools.find(|tool| tool.number == number);
                known.map(|tool| tool.uri.clone())
            }
            // The ring is between open and locked, or the converter does not answer.
            Some(ChangerReading::Intermediate) | None => None,
        };
        self.change(|state| state.current = current);
    }

    fn change(&self, change: impl FnOnce(&mut ToolState)) {
        self.shown.send_if_modified(|state| {
            let before = state.clone();
            change(state);
            *state != before
        });
    }

    /// Returns the dock of a tool: the position that was used last, or its configured dock.
    fn dock(&self, tool: &Tool) -> [f64; 6] {
        let docks = self.docks.lock().unwrap_or_else(PoisonError::into_inner);
        docks.get(&tool.number).copied().unwrap_or(tool.dock)
    }

    fn remember(&self, tool: &Tool) {
        let mut docks = self.docks.lock().unwrap_or_else(PoisonError::into_inner);
        docks.insert(tool.number, tool.dock);
    }
}

/// Returns the state before the first measurement.
fn shown_at_first(settings: &KelvinSettings, mover: &Mover) -> ToolState {
    let mover = match mover {
        Mover::Component(Some(Partner::At(endpoint))) => endpoint.clone(),
        Mover::Component(Some(Partner::Called(_)) | None) | Mover::Skills { .. } => String::new(),
    };
    ToolState {
        plate: settings.plate,
        current: None,
        mover,
    }
}

#[async_trait]
impl Device for KelvinChanger {
    fn driver(
        &self,
        types: &[ParameterType],
        peers: &PeerAccess,
    ) -> Result<Arc<dyn Driver>, DriverFault> {
        let is = |name: &str| types.contains(&ParameterType::own(name));
        let what = if is("ChangeToolSkillType") {
            ChangerAction::Change
        } else if is("AttachToolSkillType") {
            ChangerAction::Attach
        } else if is("DetachToolSkillType") {
            ChangerAction::Detach
        } else {
            let does = "ChangeToolSkillType, AttachToolSkillType, DetachToolSkillType and what is below them";
            return Err(other_type("kelvin_tool_changer", does, types));
        };
        let changer = Self {
            peers: peers.clone(),
            ..self.clone()
        };
        Ok(Arc::new(Change { changer, what }))
    }

    fn looks_for_others(&self) -> bool {
        matches!(self.mover, Mover::Component(_))
    }

    fn tool_changer(&self) -> Option<watch::Receiver<ToolState>> {
        Some(self.shown.subscribe())
    }

    fn values(&self) -> &'static [DeviceValue] {
        &VALUES
    }

    async fn measure(&self, period: Duration, out: &Measured) -> String {
        let mut ticks = ticks(period);
        let mut look = self.look();
        loop {
            ticks.tick().await;
            let volts = match look.volts().await {
                Ok(volts) => volts,
                Err(why) => return why.to_string(),
            };
            out.put("Voltage", Ok(volts.into()));
            let number = match look.reading(volts) {
                Ok(ChangerReading::Ready | ChangerReading::NoTool) => Ok(SkillValue::Byte(0)),
                Ok(ChangerReading::Tool(number)) => Ok(SkillValue::Byte(number)),
                Ok(between @ ChangerReading::Intermediate) => Err(between.to_string()),
                Err(why) => Err(why.to_string()),
            };
            out.put("ToolNumber", number.map_err(UnknownValue::Reported));
        }
    }

    async fn tend(&self, peers: &PeerAccess) {
        let measure = async {
            let mut look = self.look();
            loop {
                let reading = look.steady().await;
                self.show(reading.ok());
                sleep(SHOWN_EVERY).await;
            }
        };
        let find = async {
            loop {
                self.find_robot(peers).await;
                sleep(SHOWN_EVERY).await;
            }
        };
        tokio::join!(measure, find);
    }
}

impl KelvinChanger {
    /// Looks for the robot until it is found, without waiting for it.
    async fn find_robot(&self, peers: &PeerAccess) {
        let Mover::Component(partner) = &self.mover else {
            return;
        };
        // The endpoint of a robot that is named by its ApplicationUri changes when it restarts.
        let is_called = matches!(partner, Some(Partner::Called(_)));
        if !is_called && !self.shown.borrow().mover.is_empty() {
            return;
        }
        if let Ok(Chosen { endpoint, .. }) = peers.carrier(partner.as_ref(), &[]).await {
            self.change(|state| state.mover = endpoint);
        }
    }
}

/// The action of a skill.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ChangerAction {
    Attach,
    Detach,
    Change,
}

#[derive(Debug)]
struct Change {
    changer: KelvinChanger,
    what: ChangerAction,
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

    /// Returns the move away from the dock with the tool.
    fn leave(&self) -> Way {
        ("Approach", true, self.beside((FRONT, APPROACH), LOCKED))
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

/// Returns the positions of the moves to put a tool and to take another one, m.
fn targets(put: Option<&Tool>, take: Option<&Tool>) -> Vec<[f64; 3]> {
    let put = put.into_iter().flat_map(Tool::put);
    let take = take.into_iter();
    let take = take.flat_map(|tool| tool.take().into_iter().chain([tool.leave()]));
    let position = |(_, _, [x, y, z, ..]): Way| [x, y, z];
    put.chain(take).map(position).collect()
}

/// Returns whether the axis of a flange is vertical. The ring of the changer is turned about the
/// vertical axis of the robot's base, so docks that are tilted do not fit.
pub(crate) fn is_vertical([.., a, b, c]: [f64; 6]) -> bool {
    let flange = Frame::of_pose([0.0, 0.0, 0.0, a, b, c]);
    let [.., along] = flange.then(&Frame::at([0.0, 0.0, 1.0])).position();
    along.abs() >= LEAST_VERTICAL
}

#[async_trait]
impl Driver for Change {
    /// Halt waits for the moves of the robot.
    fn halt_timeout(&self) -> Option<Duration> {
        Some(COMPOSITE_HALT_TIMEOUT)
    }

    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        if let Some(pose) = tool_position(parameters).filter(|pose| !is_vertical(*pose)) {
            return Err(InvalidParameter::Unexpected {
                name: TOOL_POSITION.to_owned(),
                given: Some(pose.into()),
                expected: format!("is no dock: {NOT_VERTICAL}"),
            });
        }
        match self.what {
            ChangerAction::Detach => Ok(()),
            ChangerAction::Attach | ChangerAction::Change => self.wanted(parameters).map(drop),
        }
    }

    fn uses(&self) -> Vec<String> {
        match &self.changer.mover {
            Mover::Component(_) => ["PtpMoveSkillType", "LinearMoveSkillType"]
                .map(|of| format!("{:?} {of}", self.changer.mover))
                .into(),
            Mover::Skills { .. } => Vec::new(),
        }
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let mut look = self.changer.look();
        let now = look.steady().await?;
        self.changer.show(Some(now));
        let wanted = match self.what {
            ChangerAction::Detach => None,
            ChangerAction::Attach | ChangerAction::Change => {
                Some(self.at(self.wanted(work.parameters())?, Some(work.parameters())))
            }
        };
        let wanted = wanted.as_ref();
        let attached = match now {
            ChangerReading::Intermediate => {
                return Err(KelvinError::Between { now }.into());
            }
            ChangerReading::Ready | ChangerReading::NoTool => None,
            ChangerReading::Tool(number) => Some(number),
        };
        if attached == wanted.map(|tool| tool.number) {
            if let Some(tool) = wanted {
                self.await_ready(tool, None, &work).await?;
            }
            return Ok(attached_tool(wanted));
        }
        let put = match (attached, self.what) {
            (Some(number), ChangerAction::Attach) => {
                return Err(KelvinError::Occupied { number }.into());
            }
            (Some(number), ChangerAction::Change) => Some(self.at(self.tool(number)?, None)),
            (Some(number), ChangerAction::Detach) => {
                Some(self.at(self.tool(number)?, Some(work.parameters())))
            }
            (None, _) => None,
        };
        let put = put.as_ref();
        let changer = &self.changer;
        let found = |endpoint: &str| changer.change(|state| endpoint.clone_into(&mut state.mover));
        let targets = targets(put, wanted);
        let opened = ConnectedMover::open(&changer.mover, &changer.peers, &targets, found, &work);
        let mover = opened.await?;
        let moved = self.moved(&mover, &mut look, (put, wanted), &work).await;
        match moved {
            Ok(locked) => {
                let ready = match wanted {
                    Some(tool) => self.await_ready(tool, locked, &work).await,
                    None => Ok(()),
                };
                mover.close().await;
                ready?;
                Ok(attached_tool(wanted))
            }
            Err(why) => {
                mover.close().await;
                let now = look.steady().await;
                self.changer.show(now.as_ref().ok().copied());
                let error = KelvinError::After {
                    why: Box::new(why),
                    now: now.map_err(Box::new),
                };
                Err(error.into())
            }
        }
    }
}

impl Change {
    fn wanted(&self, parameters: &Parameters) -> Result<&Tool, InvalidParameter> {
        let uri = parameters
            .text("ToolAppUri")
            .ok_or_else(|| InvalidParameter::missing("ToolAppUri", "text"))?;
        let mut tools = self.changer.settings.tools.iter();
        tools.find(|tool| tool.uri == uri).ok_or_else(|| {
            let known: Vec<&str> = self
                .changer
                .settings
                .tools
                .iter()
                .map(|tool| tool.uri.as_str())
                .collect();
            InvalidParameter::Unexpected {
                name: "ToolAppUri".to_owned(),
                given: Some(uri.into()),
                expected: format!("is one of {}", known.join(", ")),
            }
        })
    }

    /// Returns a tool at the ToolPosition of a request, or at its dock.
    fn at(&self, tool: &Tool, parameters: Option<&Parameters>) -> Tool {
        let given = parameters.and_then(tool_position);
        Tool {
            dock: given.unwrap_or_else(|| self.changer.dock(tool)),
            ..tool.clone()
        }
    }

    /// Switches the component of a tool off before the tool loses its supply.
    async fn power_off(&self, tool: &Tool, work: &Work) -> Result<(), KelvinError> {
        let Some(detector) = &self.changer.peers.detector else {
            return Ok(());
        };
        let all = detector.all();
        let Some(found) = all.into_iter().find(|one| one.application_uri == tool.uri) else {
            work.note(format!("{} is not found, and not switched off", tool.uri))
                .await;
            return Ok(());
        };
        work.step("PowerOff").await;
        let refused = |why: &dyn fmt::Display| format!("{} is not switched off: {why}", tool.uri);
        let client = self.changer.peers.connect(&found.endpoint).await;
        let client = match client {
            Ok(client) => client,
            Err(why) => {
                // The component has lost its supply already, or has never started.
                work.note(refused(&why)).await;
                return Ok(());
            }
        };
        let handle = client.handle(&found.skill);
        let off = handle.power_off(Duration::ZERO).await;
        let note = match &off {
            Ok(true) => {
                let gone = timeout(OFF_WITHIN, client.lost()).await;
                let gone = gone.map_or("does not end", |_| "is switched off");
                format!("{} {gone}", tool.uri)
            }
            Ok(false) => format!("{} has no PowerOffDevice", tool.uri),
            Err(fault) => refused(fault),
        };
        client.close().await;
        work.note(note).await;
        off.map(drop).map_err(|fault| KelvinError::NotOff {
            uri: tool.uri.clone(),
            fault,
        })
    }

    /// Waits until the component of a tool is found and its skills have a state. `locked` is the
    /// time at which this run locked the tool.
    async fn await_ready(
        &self,
        tool: &Tool,
        locked: Option<Instant>,
        work: &Work,
    ) -> Result<(), KelvinError> {
        let Some(detector) = &self.changer.peers.detector else {
            return Ok(());
        };
        work.step("WaitForReady").await;
        let limit = self.changer.settings.ready_within;
        let mut why = "it is not found".to_owned();
        let any = ParameterType::own("SkillType");
        let ready = async {
            loop {
                let found = detector
                    .one(&any, limit, |one| one.application_uri == tool.uri)
                    .await;
                match found {
                    Ok(found) => match self.is_ready(&found.endpoint).await {
                        Ok(()) => return,
                        Err(reason) => why = reason.to_string(),
                    },
                    Err(_) => why = format!("it is not found{}", detector.unreadable()),
                }
                sleep(POLL).await;
            }
        };
        let waited = tokio::select! {
            waited = timeout(limit, ready) => waited.is_ok(),
            () = work.stopped() => return Err(KelvinError::Stopped),
        };
        if !waited {
            return Err(KelvinError::NotReady {
                uri: tool.uri.clone(),
                within: limit,
                why,
            });
        }
        let uri = &tool.uri;
        work.note(match locked.map(|locked| locked.elapsed().as_millis()) {
            Some(took) => format!("{uri} is ready {took} ms after it was locked"),
            None => format!("{uri} is ready"),
        })
        .await;
        Ok(())
    }

    async fn is_ready(&self, endpoint: &str) -> Result<(), PartnerError> {
        let client = self.changer.peers.connect(endpoint).await?;
        let ready = async {
            for skill in client.skills().await? {
                client.handle(&skill).state().await?;
            }
            Ok(())
        };
        let ready: Result<(), SkillFault> = ready.await;
        client.close().await;
        ready.map_err(|fault| PartnerError::Component {
            endpoint: endpoint.to_owned(),
            fault,
        })
    }

    fn tool(&self, number: u8) -> Result<&Tool, KelvinError> {
        let mut tools = self.changer.settings.tools.iter();
        tools
            .find(|tool| tool.number == number)
            .ok_or(KelvinError::NoDock { number })
    }

    /// Puts a tool and takes another one. Returns the time at which the tool was locked.
    async fn moved(
        &self,
        mover: &ConnectedMover,
        look: &mut Look,
        (put, take): (Option<&Tool>, Option<&Tool>),
        work: &Work,
    ) -> Result<Option<Instant>, KelvinError> {
        let within = self.changer.settings.within;
        let mut locked = None;
        if let Some(tool) = put {
            self.power_off(tool, work).await?;
            mover.go(&tool.put(), within, work).await?;
            work.step("WaitForRelease").await;
            look.until(ChangerReading::NoTool, work).await?;
            self.changer.remember(tool);
            self.changer.show(Some(ChangerReading::NoTool));
        }
        if let Some(tool) = take {
            mover.go(&tool.take(), within, work).await?;
            work.step("WaitForTool").await;
            look.until(ChangerReading::Tool(tool.number), work).await?;
            locked = Some(Instant::now());
            self.changer.remember(tool);
            self.changer.show(Some(ChangerReading::Tool(tool.number)));
            mover.go(&[tool.leave()], within, work).await?;
        }
        Ok(locked)
    }
}

/// Returns the ToolPosition of a request, unless it is left to the changer.
fn tool_position(parameters: &Parameters) -> Option<[f64; 6]> {
    let given = parameters.six(TOOL_POSITION)?;
    given.iter().any(|number| *number != 0.0).then_some(given)
}

fn attached_tool(tool: Option<&Tool>) -> RunResults {
    let uri = tool.map(|tool| tool.uri.as_str()).unwrap_or_default();
    vec![("Tool".to_owned(), uri.into())]
}

/// The values of a changer.
const VALUES: [DeviceValue; 2] = [
    DeviceValue {
        unit: Some("V"),
        range: Some((0.0, 15.0)),
        ..value("Voltage", Builtin::Double, "The voltage at the changer.")
    },
    value(
        "ToolNumber",
        Builtin::Byte,
        "The number of the attached tool; 0 for none.",
    ),
];

const TOOL_POSITION: &str = "ToolPosition";
/// The reason against a dock whose flange is tilted.
pub(crate) const NOT_VERTICAL: &str =
    "the axis of the flange has to be vertical, with rotations about x and y of 0 or half a turn";
/// The cosine of the largest tilt of a flange at a dock, 1 degree.
const LEAST_VERTICAL: f64 = 0.999_85;
/// Offsets for moving into and out of a dock, in m.
const BACK: f64 = 0.045;
const FRONT: f64 = 0.15;
const APPROACH: f64 = 0.1;
const OVERSHOOT: f64 = 0.001;
/// Rotations of the ring, in degrees.
const LOCKED: f64 = -63.0;
const OVERTURN: f64 = 2.0;
const UNLOCKED: f64 = 4.0;
/// Interval of the measurements for clients, beside those of a run.
const SHOWN_EVERY: Duration = Duration::from_millis(500);
/// Time limit for the end of a component that is switched off.
const OFF_WITHIN: Duration = Duration::from_secs(5);
const POLL: Duration = Duration::from_millis(100);
const SWITCHED: Duration = Duration::from_secs(10);

#[cfg(test)]
mod tests;
