//! Modbus client (Application Protocol V1.1b3): bounded waits, a new connection after each fault.

pub(crate) mod server;

use std::borrow::Cow;
use std::fmt;
use std::io;
use std::sync::{Arc, Mutex as StdMutex, PoisonError, Weak};
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::sync::Mutex;
use tokio::time::timeout;
use tokio_modbus::client::{Client as _, Context, rtu, tcp};
use tokio_modbus::{Request, Response, Slave};

use crate::line::ModbusLine;
use crate::tty::Tty;

/// Time limit of an answer. Halt leaves a driver a second, enough for two requests.
const ANSWER: Duration = Duration::from_millis(300);

/// The connections in use.
static SHARED: StdMutex<Vec<Weak<Modbus>>> = StdMutex::new(Vec::new());

/// A device behind a line. The connection is opened on request, and opened again after each
/// fault: a late answer is never used for another request.
pub(crate) struct Modbus {
    line: ModbusLine,
    unit: u8,
    context: Mutex<Option<Context>>,
}

/// Error of a request.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ModbusFault {
    /// There is no connection.
    #[error("{line} cannot be reached: {why}")]
    Unreachable {
        /// The line.
        line: String,
        /// The error of the system.
        why: String,
    },
    /// The device does not answer.
    #[error("no answer from unit {unit} at {line} within {} ms", ANSWER.as_millis())]
    Silent {
        /// The line.
        line: String,
        /// The unit.
        unit: u8,
    },
    /// The response does not match the request.
    #[error("the answer of unit {unit} at {line} is damaged: {why}")]
    Damaged {
        /// The line.
        line: String,
        /// The unit.
        unit: u8,
        /// Description of the error.
        why: String,
    },
    /// The device responded with an exception.
    #[error("unit {unit} at {line} refuses: {exception}")]
    Refused {
        /// The line.
        line: String,
        /// The unit.
        unit: u8,
        /// The exception, such as `Illegal data address`.
        exception: String,
    },
}

impl fmt::Debug for Modbus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "unit {} at {}", self.unit, self.line)
    }
}

impl From<ModbusFault> for String {
    fn from(fault: ModbusFault) -> Self {
        fault.to_string()
    }
}

impl Modbus {
    pub(crate) fn new(line: ModbusLine, unit: u8) -> Self {
        Self {
            line,
            unit,
            context: Mutex::new(None),
        }
    }

    /// Returns the connection to a unit, which all users of this unit in the program share: many
    /// devices serve a single connection.
    pub(crate) fn shared(line: &ModbusLine, unit: u8) -> Arc<Self> {
        let mut shared = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
        shared.retain(|known| known.strong_count() > 0);
        let mut known = shared.iter().filter_map(Weak::upgrade);
        if let Some(same) = known.find(|known| known.line == *line && known.unit == unit) {
            return same;
        }
        let new = Arc::new(Self::new(line.clone(), unit));
        shared.push(Arc::downgrade(&new));
        new
    }

    /// Reads holding registers (function 3).
    pub(crate) async fn holding(&self, address: u16, count: u16) -> Result<Vec<u16>, ModbusFault> {
        let answer = self
            .ask(Request::ReadHoldingRegisters(address, count))
            .await?;
        if let Response::ReadHoldingRegisters(words) = answer
            && words.len() == usize::from(count)
        {
            return Ok(words);
        }
        Err(self.damaged("not as many registers as were asked for"))
    }

    /// Reads input registers (function 4).
    pub(crate) async fn input(&self, address: u16, count: u16) -> Result<Vec<u16>, ModbusFault> {
        let answer = self
            .ask(Request::ReadInputRegisters(address, count))
            .await?;
        if let Response::ReadInputRegisters(words) = answer
            && words.len() == usize::from(count)
        {
            return Ok(words);
        }
        Err(self.damaged("not as many registers as were asked for"))
    }

    /// Writes holding registers (function 16).
    pub(crate) async fn write(&self, address: u16, words: &[u16]) -> Result<(), ModbusFault> {
        let request = Request::WriteMultipleRegisters(address, Cow::Owned(words.to_vec()));
        self.ask(request).await.map(drop)
    }

    /// Sends a request. If it fails on an existing connection, which may be stale, the request is
    /// repeated once on a new connection.
    async fn ask(&self, request: Request<'static>) -> Result<Response, ModbusFault> {
        let mut kept = self.context.lock().await;
        // A dropped future leaves no connection behind that could still receive its answer.
        if let Some(context) = kept.take()
            && let Ok((context, response)) = self.once(context, request.clone()).await
        {
            *kept = Some(context);
            return response;
        }
        let context = self.connect().await?;
        let (context, response) = self.once(context, request).await?;
        *kept = Some(context);
        response
    }

    /// Sends a request once. Returns the response or exception with the connection, or a fault that
    /// ends the connection.
    async fn once(
        &self,
        mut context: Context,
        request: Request<'static>,
    ) -> Result<(Context, Result<Response, ModbusFault>), ModbusFault> {
        let (line, unit) = (self.line.to_string(), self.unit);
        match timeout(ANSWER, context.call(request)).await {
            Err(_) => Err(ModbusFault::Silent { line, unit }),
            Ok(Err(tokio_modbus::Error::Transport(error))) if is_broken(&error) => {
                let why = error.to_string();
                Err(ModbusFault::Unreachable { line, why })
            }
            Ok(Err(error)) => Err(self.damaged(&error.to_string())),
            Ok(Ok(Err(exception))) => {
                let exception = exception.to_string();
                let refused = ModbusFault::Refused {
                    line,
                    unit,
                    exception,
                };
                Ok((context, Err(refused)))
            }
            Ok(Ok(Ok(response))) => Ok((context, Ok(response))),
        }
    }

    async fn connect(&self) -> Result<Context, ModbusFault> {
        let (line, unit) = (self.line.to_string(), Slave(self.unit));
        let unreachable = |error: io::Error| ModbusFault::Unreachable {
            line: line.clone(),
            why: error.to_string(),
        };
        match &self.line {
            ModbusLine::Serial { path, baud } => {
                let tty = Tty::open(path, *baud).map_err(unreachable)?;
                Ok(rtu::attach_slave(tty, unit))
            }
            ModbusLine::Tcp(address) => {
                let stream = connected(address).await.map_err(unreachable)?;
                Ok(tcp::attach_slave(stream, unit))
            }
            ModbusLine::RtuOverTcp(address) => {
                let stream = connected(address).await.map_err(unreachable)?;
                Ok(rtu::attach_slave(stream, unit))
            }
        }
    }

    fn damaged(&self, why: &str) -> ModbusFault {
        ModbusFault::Damaged {
            line: self.line.to_string(),
            unit: self.unit,
            why: why.chars().take(200).collect(),
        }
    }
}

pub(crate) async fn connected(address: &str) -> io::Result<TcpStream> {
    let stream = match timeout(ANSWER, TcpStream::connect(address)).await {
        Ok(stream) => stream?,
        Err(_) => return Err(io::ErrorKind::TimedOut.into()),
    };
    stream.set_nodelay(true)?;
    Ok(stream)
}

/// Returns whether an error comes from the connection, and not from a received response.
fn is_broken(error: &io::Error) -> bool {
    use io::ErrorKind as Kind;
    !matches!(
        error.kind(),
        Kind::InvalidData | Kind::InvalidInput | Kind::Other
    )
}
