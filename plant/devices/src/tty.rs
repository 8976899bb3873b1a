//! Serial ports and pseudo-terminals without blocking.

use std::io;
use std::os::fd::AsRawFd as _;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use serial2::SerialPort;
use tokio::io::unix::AsyncFd;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

/// An end of a serial line.
#[derive(Debug)]
pub(crate) struct Tty(AsyncFd<SerialPort>);

/// A pseudo-terminal: data written to one end is read at the other.
#[derive(Debug)]
pub(crate) struct Pty {
    /// The end of the creator.
    pub(crate) own: Tty,
    /// Path for opening the other end.
    pub(crate) path: PathBuf,
    /// Keeps the other end open, so that reading does not fail between two programs that open it.
    _held: SerialPort,
}

impl Tty {
    /// Opens a port with 8 bits, no parity and one stop bit, and discards buffered data.
    pub(crate) fn open(path: &Path, baud: u32) -> io::Result<Self> {
        let port = SerialPort::open(path, baud)?;
        port.discard_buffers()?;
        Ok(Self(registered(port)?))
    }
}

impl Pty {
    /// Creates a pseudo-terminal.
    pub(crate) fn new() -> io::Result<Self> {
        let (own, other) = SerialPort::pair()?;
        let path = std::fs::read_link(format!("/proc/self/fd/{}", other.as_raw_fd()))?;
        Ok(Self {
            own: Tty(registered(own)?),
            path,
            _held: other,
        })
    }
}

fn registered(port: SerialPort) -> io::Result<AsyncFd<SerialPort>> {
    #[expect(
        deprecated,
        reason = "the other way is unsafe: it asks for what owns its descriptor and keeps it, as a SerialPort does"
    )]
    AsyncFd::new(port)
}

impl AsyncRead for Tty {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        loop {
            let mut ready = ready!(self.0.poll_read_ready(context))?;
            let unfilled = buffer.initialize_unfilled();
            let read = ready.try_io(|port| Ok(rustix::io::read(port.get_ref(), unfilled)?));
            if let Ok(read) = read {
                buffer.advance(read?);
                return Poll::Ready(Ok(()));
            }
        }
    }
}

impl AsyncWrite for Tty {
    fn poll_write(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        loop {
            let mut ready = ready!(self.0.poll_write_ready(context))?;
            let written = ready.try_io(|port| Ok(rustix::io::write(port.get_ref(), bytes)?));
            if let Ok(written) = written {
                return Poll::Ready(written);
            }
        }
    }

    fn poll_flush(self: Pin<&mut Self>, _context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}
