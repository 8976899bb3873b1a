//! The interfaces of the robot: RTDE, and the secondary interface.

use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, interval};
use tracing::debug;

use super::super::script::programs;
use super::super::wire::{RecipeType, RecipeValue, Type, VERSION, chunk, next, package};
use super::{UrSimulator, variables};

/// A robot that is served, until it is dropped.
#[derive(Debug)]
pub struct ServedRobot {
    rtde: SocketAddr,
    secondary: SocketAddr,
    _tasks: JoinSet<()>,
}

impl ServedRobot {
    /// Serves a robot; port 0 selects a free port. Needs a tokio runtime.
    ///
    /// # Errors
    /// Fails if an address cannot be used.
    pub async fn start(simulator: &UrSimulator, rtde: &str, secondary: &str) -> io::Result<Self> {
        let (told, programs) = (
            TcpListener::bind(rtde).await?,
            TcpListener::bind(secondary).await?,
        );
        let (rtde, secondary) = (told.local_addr()?, programs.local_addr()?);
        let mut tasks = JoinSet::new();
        let taken = Taken::default();
        tasks.spawn(accept(told, simulator.clone(), Some(taken)));
        tasks.spawn(accept(programs, simulator.clone(), None));
        Ok(Self {
            rtde,
            secondary,
            _tasks: tasks,
        })
    }

    /// Returns the address of RTDE.
    #[must_use]
    pub fn rtde(&self) -> SocketAddr {
        self.rtde
    }

    /// Returns the address of the secondary interface.
    #[must_use]
    pub fn secondary(&self) -> SocketAddr {
        self.secondary
    }
}

/// Inputs that belong to a client and are refused to all other clients.
type Taken = Arc<Mutex<Vec<String>>>;

async fn accept(listener: TcpListener, simulator: UrSimulator, taken: Option<Taken>) {
    let mut clients = JoinSet::new();
    loop {
        let Ok((stream, from)) = listener.accept().await else {
            tokio::time::sleep(LATER).await;
            continue;
        };
        while clients.try_join_next().is_some() {}
        if clients.len() >= MOST_CLIENTS {
            continue;
        }
        let (simulator, taken) = (simulator.clone(), taken.clone());
        clients.spawn(async move {
            let life = simulator.lock().life;
            let ended = tokio::select! {
                () = switched_off(&simulator, life) => Ok(()),
                ended = serve(stream, &simulator, taken) => ended,
            };
            debug!("{from} has gone: {ended:?}");
        });
    }
}

async fn serve(stream: TcpStream, simulator: &UrSimulator, taken: Option<Taken>) -> io::Result<()> {
    stream.set_nodelay(true)?;
    match taken {
        Some(taken) => Client::new(simulator, taken).serve(stream).await,
        None => secondary(stream, simulator).await,
    }
}

async fn switched_off(simulator: &UrSimulator, life: u32) {
    let mut looks = interval(LATER);
    while simulator.lock().life == life {
        looks.tick().await;
    }
}

/// Accepts programs, and sends the state of the robot ten times a second.
async fn secondary(stream: TcpStream, simulator: &UrSimulator) -> io::Result<()> {
    let (mut reads, mut writes) = stream.into_split();
    let mut ticks = interval(Duration::from_millis(100));
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let (mut text, mut bytes) = (String::new(), [0; 1024]);
    loop {
        tokio::select! {
            read = reads.read(&mut bytes) => {
                let read = read?;
                if read == 0 {
                    return Ok(());
                }
                text.push_str(&String::from_utf8_lossy(bytes.get(..read).unwrap_or_default()));
                if text.len() > LONGEST_PROGRAM {
                    return Err(io::ErrorKind::InvalidData.into());
                }
                for program in programs(&mut text) {
                    match program {
                        Ok(statements) => simulator.run(statements),
                        Err(line) => debug!("the robot does not understand {line}"),
                    }
                }
            }
            _ = ticks.tick() => {
                let state = simulator.state_message();
                if let Some(state) = state {
                    writes.write_all(&state).await?;
                }
            }
        }
    }
}

impl UrSimulator {
    /// Returns a robot state message of type 16: mode and tool position. Returns `None` while the
    /// robot is silent.
    fn state_message(&self) -> Option<Vec<u8>> {
        let robot = self.lock();
        if robot.silent {
            return None;
        }
        let mut mode = Vec::new();
        let on_ms = robot.seen.duration_since(robot.switched_on).as_millis();
        mode.extend(u64::try_from(on_ms).unwrap_or(u64::MAX).to_be_bytes());
        let runs = robot.program.is_some() && !robot.paused;
        let protective = robot.safety == 3;
        // Connected, enabled, powered; emergency and protective stop; program running, paused.
        mode.extend([true, true, true, false, protective, runs, false].map(u8::from));
        mode.extend([u8::try_from(robot.mode()).unwrap_or_default(), 0]);
        for fraction in [robot.slider, robot.slider, 1.0] {
            mode.extend(fraction.to_be_bytes());
        }
        mode.push(0);
        let mut place = Vec::new();
        for part in robot.pose.into_iter().chain([0.0; 6]) {
            place.extend(part.to_be_bytes());
        }
        let mut body = vec![16];
        for (of, part) in [(0_u8, mode), (4, place)] {
            let length = u32::try_from(part.len() + 5).unwrap_or(u32::MAX);
            body.extend(length.to_be_bytes());
            body.push(of);
            body.extend(part);
        }
        let length = u32::try_from(body.len() + 4).unwrap_or(u32::MAX);
        let mut message = length.to_be_bytes().to_vec();
        message.extend(body);
        Some(message)
    }
}

/// A client of RTDE.
struct Client<'s> {
    simulator: &'s UrSimulator,
    taken: Taken,
    /// The inputs of the client.
    has: Vec<String>,
    outputs: Vec<(String, RecipeType)>,
    /// Its recipes of inputs; the number of a recipe is its index plus 1.
    inputs: Vec<Vec<(String, RecipeType)>>,
    hertz: f64,
    started: bool,
}

impl<'s> Client<'s> {
    fn new(simulator: &'s UrSimulator, taken: Taken) -> Self {
        Self {
            simulator,
            taken,
            has: Vec::new(),
            outputs: Vec::new(),
            inputs: Vec::new(),
            hertz: 125.0,
            started: false,
        }
    }

    async fn serve(mut self, stream: TcpStream) -> io::Result<()> {
        let (reads, mut writes) = stream.into_split();
        let (send, mut packages) = mpsc::channel(16);
        let mut reader = JoinSet::new();
        reader.spawn(read(reads, send));
        let mut ticks = self.ticks();
        loop {
            tokio::select! {
                package = packages.recv() => {
                    let Some((of, body)) = package else {
                        return Ok(());
                    };
                    let hertz = self.hertz;
                    self.take(of, &body, &mut writes).await?;
                    if hertz.to_bits() != self.hertz.to_bits() {
                        ticks = self.ticks();
                    }
                }
                _ = ticks.tick(), if self.started => {
                    if let Some(data) = self.data()? {
                        writes.write_all(&data).await?;
                    }
                }
            }
        }
    }

    fn ticks(&self) -> tokio::time::Interval {
        let mut ticks = interval(Duration::from_secs_f64(1.0 / self.hertz.clamp(1.0, 500.0)));
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        ticks
    }

    fn data(&self) -> io::Result<Option<Vec<u8>>> {
        let robot = self.simulator.lock();
        if robot.silent {
            return Ok(None);
        }
        let mut body = vec![1];
        for (name, kind) in &self.outputs {
            robot.tells(name, *kind).put(&mut body);
        }
        package(Type::Data, &body).map(Some)
    }

    async fn take(&mut self, of: Type, body: &[u8], writes: &mut OwnedWriteHalf) -> io::Result<()> {
        if self.simulator.lock().silent {
            return Ok(());
        }
        let mut fields = body;
        let answer = match of {
            Type::Protocol => vec![u8::from(
                chunk(&mut fields).map(u16::from_be_bytes) == Some(VERSION),
            )],
            Type::Controller => CONTROLLER.into_iter().flat_map(u32::to_be_bytes).collect(),
            Type::Outputs => {
                self.hertz = chunk(&mut fields).map_or(125.0, f64::from_be_bytes);
                self.outputs_agreed(&String::from_utf8_lossy(fields))
            }
            Type::Inputs => self.inputs_agreed(&String::from_utf8_lossy(fields)),
            Type::Start => {
                self.started = !self.outputs.is_empty();
                vec![u8::from(self.started)]
            }
            Type::Pause => {
                self.started = false;
                vec![1]
            }
            Type::Data => {
                self.told(fields);
                return Ok(());
            }
            Type::Text => return Ok(()),
        };
        writes.write_all(&package(of, &answer)?).await
    }

    fn outputs_agreed(&mut self, names: &str) -> Vec<u8> {
        let lacks = self.simulator.lock().settings.lacks;
        let of = |name: &str| variables::output(name).filter(|_| !lacks.contains(&name));
        let found: Vec<(&str, Option<RecipeType>)> =
            listed(names).map(|name| (name, of(name))).collect();
        let mut answer = vec![1];
        answer.extend(kinds(&found).bytes());
        let all: Option<Vec<(String, RecipeType)>> = found
            .into_iter()
            .map(|(name, kind)| Some((name.to_owned(), kind?)))
            .collect();
        match all {
            Some(all) => self.outputs = all,
            // No recipe.
            None => answer.iter_mut().take(1).for_each(|number| *number = 0),
        }
        answer
    }

    fn inputs_agreed(&mut self, names: &str) -> Vec<u8> {
        let mut taken = self.taken.lock().unwrap_or_else(PoisonError::into_inner);
        let mut told = Vec::new();
        let mut recipe = Vec::new();
        for name in listed(names) {
            // A client may have an input in several recipes of its own.
            let own = self.has.iter().any(|of| of == name);
            let in_use = !own && taken.iter().any(|of| of == name);
            match variables::input(name) {
                Some(_) if in_use => told.push("IN_USE"),
                Some(kind) => {
                    told.push(kind.name());
                    recipe.push((name.to_owned(), kind));
                }
                None => told.push("NOT_FOUND"),
            }
        }
        let agreed = recipe.len() == told.len() && self.inputs.len() < MOST_RECIPES;
        let mut answer = vec![0];
        if agreed {
            let names = recipe.iter().map(|(name, _)| name.clone());
            self.has.extend(names.clone());
            taken.extend(names);
            self.inputs.push(recipe);
            answer = vec![u8::try_from(self.inputs.len()).unwrap_or_default()];
        }
        answer.extend(told.join(",").bytes());
        answer
    }

    fn told(&self, mut fields: &[u8]) {
        let recipe = chunk(&mut fields).and_then(|[number]| {
            let place = usize::from(number).checked_sub(1)?;
            self.inputs.get(place)
        });
        let values: Option<Vec<(String, RecipeValue)>> = recipe.and_then(|recipe| {
            recipe
                .iter()
                .map(|(name, kind)| Some((name.clone(), kind.take(&mut fields)?)))
                .collect()
        });
        if let Some(values) = values {
            self.simulator.told(&values);
        }
    }
}

impl Drop for Client<'_> {
    fn drop(&mut self) {
        let mut taken = self.taken.lock().unwrap_or_else(PoisonError::into_inner);
        taken.retain(|name| !self.has.contains(name));
    }
}

/// Returns the names of a list. Some clients append a comma, which is ignored.
fn listed(names: &str) -> impl Iterator<Item = &str> {
    names.strip_suffix(',').unwrap_or(names).split(',')
}

fn kinds(found: &[(&str, Option<RecipeType>)]) -> String {
    let names: Vec<&str> = found
        .iter()
        .map(|(_, kind)| kind.map_or("NOT_FOUND", RecipeType::name))
        .collect();
    names.join(",")
}

async fn read(mut reads: OwnedReadHalf, send: mpsc::Sender<(Type, Vec<u8>)>) {
    while let Ok(package) = next(&mut reads).await {
        if send.send(package).await.is_err() {
            return;
        }
    }
}

/// Major, minor, bug fix and build of a controller that supports all of this.
const CONTROLLER: [u32; 4] = [5, 12, 0, 0];
const LATER: Duration = Duration::from_millis(50);
const MOST_CLIENTS: usize = 16;
const MOST_RECIPES: usize = 255;
const LONGEST_PROGRAM: usize = 64 * 1024;
