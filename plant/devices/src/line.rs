//! The address of a device.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

/// The connection to a Modbus device.
///
/// As text `tcp://host:port` (Modbus TCP), `rtu+tcp://host:port` (RTU frames over TCP, as forwarded
/// by converters and robots for a serial line) or `serial:path[@baud]` (RTU, 8 bits, no parity, 115
/// 200 baud by default).
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ModbusLine {
    /// Modbus TCP at a host and port.
    Tcp(String),
    /// RTU frames over TCP.
    RtuOverTcp(String),
    /// RTU over a serial line.
    Serial {
        /// The device file of a serial port or a pseudo-terminal.
        path: PathBuf,
        /// Bits per second.
        baud: u32,
    },
}

/// Error for an invalid connection.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("expected tcp://host:port, rtu+tcp://host:port or serial:path[@baud], found `{0}`")]
pub struct NoLine(pub String);

impl FromStr for ModbusLine {
    type Err = NoLine;

    fn from_str(text: &str) -> Result<Self, NoLine> {
        let wrong = || NoLine(text.chars().take(80).collect());
        if let Some(rest) = text.strip_prefix("serial:") {
            let (path, baud) = match rest.rsplit_once('@') {
                Some((path, baud)) => (path, baud.parse().map_err(|_| wrong())?),
                None => (rest, USUAL_BAUD),
            };
            let fits = path.starts_with('/') && !path.contains('\0') && baud > 0;
            let path = PathBuf::from(path);
            return fits
                .then_some(Self::Serial { path, baud })
                .ok_or_else(wrong);
        }
        let (scheme, address) = text.split_once("://").ok_or_else(wrong)?;
        let (host, port) = address.rsplit_once(':').ok_or_else(wrong)?;
        if host.is_empty() || host.contains(['/', '@', ' ']) || port.parse::<u16>().is_err() {
            return Err(wrong());
        }
        match scheme {
            "tcp" => Ok(Self::Tcp(address.to_owned())),
            "rtu+tcp" => Ok(Self::RtuOverTcp(address.to_owned())),
            _ => Err(wrong()),
        }
    }
}

impl fmt::Display for ModbusLine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tcp(address) => write!(f, "tcp://{address}"),
            Self::RtuOverTcp(address) => write!(f, "rtu+tcp://{address}"),
            Self::Serial { path, baud } => write!(f, "serial:{}@{baud}", path.display()),
        }
    }
}

const USUAL_BAUD: u32 = 115_200;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_read_as_it_is_written() {
        for text in [
            "tcp://10.0.0.7:502",
            "rtu+tcp://[::1]:54321",
            "serial:/dev/ttyUSB0@9600",
        ] {
            assert_eq!(text.parse::<ModbusLine>().unwrap().to_string(), text);
        }
        let usual = "serial:/dev/pts/3".parse::<ModbusLine>().unwrap();
        assert_eq!(usual.to_string(), "serial:/dev/pts/3@115200");
        for wrong in [
            "",
            "tcp://",
            "tcp://host",
            "udp://h:1",
            "serial:",
            "serial:/x@fast",
            "tcp://a/b:1",
        ] {
            assert_eq!(wrong.parse::<ModbusLine>(), Err(NoLine(wrong.to_owned())));
        }
    }
}
