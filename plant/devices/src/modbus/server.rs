//! Modbus server: registers that clients read and write, for simulators.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio::time::timeout;
use tracing::debug;

use crate::line::ModbusLine;
use crate::tty::Pty;

/// The kind of registers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RegisterTable {
    /// Registers for reading and writing.
    Holding,
    /// Registers for reading only.
    Input,
}

/// The registers of a device.
pub trait Registers: Send + Sync {
    /// Returns the contents of `count` registers from an address on, or `None` if one of them does
    /// not exist.
    fn read(&self, table: RegisterTable, address: u16, count: u16) -> Option<Vec<u16>>;

    /// Writes holding registers. Returns false without writing if one of them does not exist or is
    /// read-only.
    fn write(&self, address: u16, words: &[u16]) -> bool;
}

/// Faults of a line. Clones share the same line.
#[derive(Debug, Clone, Default)]
pub struct LineFaults {
    silent: Arc<AtomicBool>,
    damaged: Arc<AtomicU32>,
}

impl LineFaults {
    /// Sets whether all requests remain without response.
    pub fn set_silent(&self, silent: bool) {
        self.silent.store(silent, Ordering::SeqCst);
    }

    /// Damages the given number of next responses.
    pub fn damage(&self, answers: u32) {
        self.damaged.store(answers, Ordering::SeqCst);
    }

    fn damages(&self) -> bool {
        let left = |left: u32| left.checked_sub(1);
        let taken = self
            .damaged
            .fetch_update(Ordering::SeqCst, Ordering::SeqCst, left);
        taken.is_ok()
    }
}

/// A device that is served, until it is dropped.
#[derive(Debug)]
pub struct ServedDevice {
    line: ModbusLine,
    link: Option<PathBuf>,
    _tasks: JoinSet<()>,
}

impl ServedDevice {
    /// Serves registers as the device with a unit number. Port 0 selects a free port. A serial line
    /// is a new pseudo-terminal; its path, if given, becomes a symbolic link to it. Needs a tokio
    /// runtime.
    ///
    /// # Errors
    /// Fails if the address cannot be used, or if the link cannot be created.
    pub async fn start(
        line: &ModbusLine,
        unit: u8,
        registers: Arc<dyn Registers>,
        faults: LineFaults,
    ) -> io::Result<Self> {
        let device = Device {
            unit,
            registers,
            faults,
        };
        let mut tasks = JoinSet::new();
        let (line, link) = match line {
            ModbusLine::Tcp(address) => {
                let listener = TcpListener::bind(address).await?;
                let at = listener.local_addr()?.to_string();
                tasks.spawn(accept(listener, device, Framing::Tcp));
                (ModbusLine::Tcp(at), None)
            }
            ModbusLine::RtuOverTcp(address) => {
                let listener = TcpListener::bind(address).await?;
                let at = listener.local_addr()?.to_string();
                tasks.spawn(accept(listener, device, Framing::Rtu));
                (ModbusLine::RtuOverTcp(at), None)
            }
            ModbusLine::Serial { path, baud } => {
                let pty = Pty::new()?;
                let target = pty.path.clone();
                let link = (path != std::path::Path::new("/dev/ptmx")).then(|| path.clone());
                if let Some(link) = &link {
                    std::os::unix::fs::symlink(&target, link)?;
                }
                tasks.spawn(async move {
                    // Captures the whole value, including the handle that keeps the other end open.
                    let mut pty = pty;
                    let ended = rtu(&mut pty.own, &device).await;
                    debug!("the line has ended: {ended:?}");
                });
                let path = link.clone().unwrap_or(target);
                (ModbusLine::Serial { path, baud: *baud }, link)
            }
        };
        Ok(Self {
            line,
            link,
            _tasks: tasks,
        })
    }

    /// Returns the line for clients.
    #[must_use]
    pub fn line(&self) -> &ModbusLine {
        &self.line
    }
}

impl Drop for ServedDevice {
    fn drop(&mut self) {
        if let Some(link) = &self.link
            && let Err(error) = std::fs::remove_file(link)
        {
            debug!("{} stays: {error}", link.display());
        }
    }
}

#[derive(Clone)]
struct Device {
    unit: u8,
    registers: Arc<dyn Registers>,
    faults: LineFaults,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Framing {
    Tcp,
    Rtu,
}

async fn accept(listener: TcpListener, device: Device, framing: Framing) {
    let mut clients = JoinSet::new();
    loop {
        let Ok((stream, from)) = listener.accept().await else {
            // Out of file descriptors: wait until other connections are closed.
            tokio::time::sleep(GAP).await;
            continue;
        };
        while clients.try_join_next().is_some() {}
        if clients.len() >= MOST_CLIENTS {
            debug!("{from} is one client too many");
            continue;
        }
        let device = device.clone();
        clients.spawn(async move {
            let ended = serve(stream, &device, framing).await;
            debug!("{from} has gone: {ended:?}");
        });
    }
}

async fn serve(mut stream: TcpStream, device: &Device, framing: Framing) -> io::Result<()> {
    stream.set_nodelay(true)?;
    match framing {
        Framing::Rtu => rtu(&mut stream, device).await,
        Framing::Tcp => tcp(&mut stream, device).await,
    }
}

/// Serves frames with a header of transaction, protocol, length and unit (Modbus Messaging on
/// TCP/IP, 3.1.3).
async fn tcp(stream: &mut TcpStream, device: &Device) -> io::Result<()> {
    loop {
        let transaction = stream.read_u16().await?;
        let protocol = stream.read_u16().await?;
        let length = stream.read_u16().await?;
        if protocol != 0 || !(3..=254).contains(&length) {
            return Err(io::ErrorKind::InvalidData.into());
        }
        let unit = stream.read_u8().await?;
        let mut pdu = vec![0; usize::from(length) - 1];
        stream.read_exact(&mut pdu).await?;
        if device.faults.silent.load(Ordering::SeqCst) || unit != device.unit {
            continue;
        }
        let answer = device.answer(&pdu);
        let protocol = u16::from(device.faults.damages());
        let length = u16::try_from(answer.len() + 1).unwrap_or(u16::MAX);
        let mut frame = Vec::with_capacity(answer.len() + 7);
        for word in [transaction, protocol, length] {
            frame.extend(word.to_be_bytes());
        }
        frame.push(unit);
        frame.extend(answer);
        stream.write_all(&frame).await?;
    }
}

/// Serves frames of unit, request and checksum with a gap between them (Modbus over Serial Line
/// V1.02, 2.5.1).
async fn rtu(line: &mut (impl AsyncRead + AsyncWrite + Unpin), device: &Device) -> io::Result<()> {
    let mut frame: Vec<u8> = Vec::new();
    let mut bytes = [0; LONGEST];
    loop {
        let read = match timeout(GAP, line.read(&mut bytes)).await {
            Ok(read) => read?,
            Err(_) => {
                // A frame that is incomplete after a gap stays incomplete.
                frame.clear();
                continue;
            }
        };
        if read == 0 {
            return Ok(());
        }
        frame.extend(bytes.iter().take(read));
        if frame.len() > LONGEST {
            frame.clear();
        }
        let Some(length) = frame_length(&frame).filter(|length| frame.len() >= *length) else {
            continue;
        };
        let whole: Vec<u8> = frame.drain(..length).collect();
        let Some((body, sum)) = whole.split_last_chunk::<2>() else {
            continue;
        };
        if crc(body) != u16::from_le_bytes(*sum) {
            frame.clear();
            continue;
        }
        let Some((unit, pdu)) = body.split_first() else {
            continue;
        };
        if device.faults.silent.load(Ordering::SeqCst) || *unit != device.unit {
            continue;
        }
        let mut answer = vec![*unit];
        answer.extend(device.answer(pdu));
        let sum = crc(&answer) ^ u16::from(device.faults.damages());
        answer.extend(sum.to_le_bytes());
        line.write_all(&answer).await?;
    }
}

/// Returns the length of a request with unit and checksum, by its function, or `None` while it is
/// unknown.
fn frame_length(frame: &[u8]) -> Option<usize> {
    match frame.get(1)? {
        0x10 => frame.get(6).map(|bytes| usize::from(*bytes) + 9),
        0x17 => frame.get(10).map(|bytes| usize::from(*bytes) + 13),
        _ => Some(8),
    }
}

/// Returns the checksum of RTU: CRC-16 with the polynomial 0xA001, low byte first on the line.
fn crc(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |sum, byte| {
        (0..8).fold(sum ^ u16::from(*byte), |sum, _| {
            if sum & 1 == 1 {
                (sum >> 1) ^ 0xA001
            } else {
                sum >> 1
            }
        })
    })
}

impl Device {
    /// Returns the response to a request: of the function, or an exception.
    fn answer(&self, pdu: &[u8]) -> Vec<u8> {
        let function = pdu.first().copied().unwrap_or_default();
        self.answered(pdu)
            .unwrap_or_else(|exception| vec![function | 0x80, exception])
    }

    fn answered(&self, pdu: &[u8]) -> Result<Vec<u8>, u8> {
        let (function, mut fields) = pdu.split_first().ok_or(ILLEGAL_FUNCTION)?;
        match function {
            0x03 | 0x04 => {
                let table = if *function == 0x03 {
                    RegisterTable::Holding
                } else {
                    RegisterTable::Input
                };
                let (address, count) = (word(&mut fields)?, word(&mut fields)?);
                self.read(*function, table, address, count)
            }
            0x06 => {
                let (address, value) = (word(&mut fields)?, word(&mut fields)?);
                self.write(address, &[value])?;
                Ok(pdu.to_vec())
            }
            0x10 => {
                let (address, count) = (word(&mut fields)?, word(&mut fields)?);
                let words = counted(&mut fields, count)?;
                self.write(address, &words)?;
                let mut answer = vec![*function];
                answer.extend(address.to_be_bytes());
                answer.extend(count.to_be_bytes());
                Ok(answer)
            }
            0x17 => {
                let (from, count) = (word(&mut fields)?, word(&mut fields)?);
                let (to, written) = (word(&mut fields)?, word(&mut fields)?);
                let words = counted(&mut fields, written)?;
                self.write(to, &words)?;
                self.read(*function, RegisterTable::Holding, from, count)
            }
            _ => Err(ILLEGAL_FUNCTION),
        }
    }

    fn read(
        &self,
        function: u8,
        table: RegisterTable,
        address: u16,
        count: u16,
    ) -> Result<Vec<u8>, u8> {
        let bytes = u8::try_from(count.saturating_mul(2))
            .ok()
            .filter(|_| (1..=125).contains(&count));
        let bytes = bytes.ok_or(ILLEGAL_VALUE)?;
        let words = self
            .registers
            .read(table, address, count)
            .ok_or(ILLEGAL_ADDRESS)?;
        let mut answer = vec![function, bytes];
        answer.extend(words.into_iter().flat_map(u16::to_be_bytes));
        Ok(answer)
    }

    fn write(&self, address: u16, words: &[u16]) -> Result<(), u8> {
        let taken = self.registers.write(address, words);
        taken.then_some(()).ok_or(ILLEGAL_ADDRESS)
    }
}

fn word(fields: &mut &[u8]) -> Result<u16, u8> {
    let (bytes, rest) = fields.split_first_chunk::<2>().ok_or(ILLEGAL_VALUE)?;
    *fields = rest;
    Ok(u16::from_be_bytes(*bytes))
}

/// Reads words that follow their length in bytes.
fn counted(fields: &mut &[u8], count: u16) -> Result<Vec<u16>, u8> {
    let (bytes, rest) = fields.split_first().ok_or(ILLEGAL_VALUE)?;
    let fits = usize::from(*bytes) == rest.len() && usize::from(count) * 2 == rest.len();
    if !fits || count == 0 {
        return Err(ILLEGAL_VALUE);
    }
    *fields = rest;
    (0..count).map(|_| word(fields)).collect()
}

const ILLEGAL_FUNCTION: u8 = 1;
const ILLEGAL_ADDRESS: u8 = 2;
const ILLEGAL_VALUE: u8 = 3;
const GAP: Duration = Duration::from_millis(20);
const LONGEST: usize = 256;
const MOST_CLIENTS: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_that_of_the_example_in_the_manual_of_the_gripper() {
        // 09 03 07 D0 00 03, followed by 04 0E on the line.
        assert_eq!(crc(&[0x09, 0x03, 0x07, 0xD0, 0x00, 0x03]), 0x0E04);
    }

    #[test]
    fn a_question_for_what_is_not_there_is_refused_and_no_length_is_believed() {
        struct Two;
        impl Registers for Two {
            fn read(&self, table: RegisterTable, address: u16, count: u16) -> Option<Vec<u16>> {
                (table == RegisterTable::Holding && address == 7 && count <= 2)
                    .then(|| vec![1; usize::from(count)])
            }

            fn write(&self, _address: u16, _words: &[u16]) -> bool {
                false
            }
        }
        let device = Device {
            unit: 1,
            registers: Arc::new(Two),
            faults: LineFaults::default(),
        };
        assert_eq!(device.answer(&[3, 0, 7, 0, 2]), [3, 4, 0, 1, 0, 1]);
        assert_eq!(device.answer(&[3, 0, 8, 0, 1]), [0x83, 2]);
        assert_eq!(device.answer(&[4, 0, 7, 0, 1]), [0x84, 2]);
        assert_eq!(device.answer(&[3, 0, 7, 0xFF, 0xFF]), [0x83, 3]);
        assert_eq!(device.answer(&[16, 0, 7, 0, 1, 4, 0, 1]), [0x90, 3]);
        assert_eq!(device.answer(&[16, 0, 7, 0, 1, 2, 0, 1]), [0x90, 2]);
        assert_eq!(device.answer(&[43]), [0xAB, 1]);
        assert_eq!(device.answer(&[]), [0x80, 1]);
    }
}
