//! System calls that receive or send several datagrams or frames.

use std::cell::RefCell;
use std::fmt;
use std::io::{self, IoSlice, IoSliceMut};
use std::net::{Ipv4Addr, SocketAddr};
use std::os::fd::{AsFd, RawFd};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use nix::cmsg_space;
use nix::sys::socket::{
    ControlMessageOwned, MsgFlags, MultiHeaders, RecvMsg, SockaddrIn, recvmmsg,
};
use nix::sys::time::TimeSpec;
use rustix::net::{MMsgHdr, SendAncillaryBuffer, SendFlags, SocketAddrAny, sendmmsg};

use crate::carrier::{BUFFER, OutgoingMessage, Received};

/// The maximum number of datagrams of a system call.
pub(crate) const AT_ONCE: usize = 32;

thread_local! {
    /// The headers of a receiving call. They refer to memory only during the call.
    static HEADERS: RefCell<MultiHeaders<SockaddrIn>> =
        RefCell::new(MultiHeaders::preallocate(AT_ONCE, Some(cmsg_space!(TimeSpec))));
}

/// The datagrams of a receiving call that were not yet taken.
pub(crate) struct Batch {
    buffers: Box<[Vec<u8>; AT_ONCE]>,
    received: [Received; AT_ONCE],
    count: usize,
    taken: usize,
}

impl fmt::Debug for Batch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Batch")
            .field("count", &self.count)
            .field("taken", &self.taken)
            .finish_non_exhaustive()
    }
}

impl Default for Batch {
    fn default() -> Self {
        let nothing = Received {
            length: 0,
            from: SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0)),
            stamp: None,
        };
        Self {
            buffers: Box::new([const { Vec::new() }; AT_ONCE]),
            received: [nothing; AT_ONCE],
            count: 0,
            taken: 0,
        }
    }
}

impl Batch {
    /// Receives the datagrams that wait in the socket, after all received datagrams were taken.
    /// Returns whether more may wait: a full batch does not show that the socket is empty.
    ///
    /// # Errors
    /// The error of the system; `WouldBlock` if no datagram waits.
    pub(crate) fn fill(&mut self, socket: RawFd) -> io::Result<bool> {
        (self.count, self.taken) = (0, 0);
        for buffer in self.buffers.iter_mut().filter(|of| of.len() < BUFFER) {
            buffer.resize(BUFFER, 0);
        }
        let (buffers, places) = (&mut self.buffers, &mut self.received);
        let count = HEADERS.with_borrow_mut(|headers| {
            let mut slices = buffers.each_mut().map(|buffer| [IoSliceMut::new(buffer)]);
            let (slices, flags) = (slices.iter_mut(), MsgFlags::MSG_DONTWAIT);
            let mut count = 0;
            for (message, place) in
                recvmmsg(socket, headers, slices, flags, None)?.zip(places.iter_mut())
            {
                let from = message.address.map(SocketAddr::from);
                *place = Received {
                    length: message.bytes,
                    from: from.unwrap_or(place.from),
                    stamp: stamp(&message),
                };
                count += 1;
            }
            io::Result::Ok(count)
        })?;
        self.count = count;
        Ok(count == AT_ONCE)
    }

    /// Takes the next datagram: `buffer` is exchanged for the buffer of the datagram.
    pub(crate) fn take(&mut self, buffer: &mut Vec<u8>) -> Option<Received> {
        let (next, received) = self.next()?;
        std::mem::swap(next, buffer);
        Some(received)
    }

    /// Copies the next datagram, which is truncated to the size of `buffer`.
    pub(crate) fn copy(&mut self, buffer: &mut [u8]) -> Option<Received> {
        let (next, mut received) = self.next()?;
        received.length = received.length.min(buffer.len());
        let to = buffer.get_mut(..received.length)?;
        to.copy_from_slice(next.get(..received.length)?);
        Some(received)
    }

    fn next(&mut self) -> Option<(&mut Vec<u8>, Received)> {
        if self.taken >= self.count {
            return None;
        }
        let next = self.taken;
        self.taken += 1;
        Some((self.buffers.get_mut(next)?, *self.received.get(next)?))
    }

    /// Drops the datagrams that were not yet taken.
    pub(crate) const fn clear(&mut self) {
        self.taken = self.count;
    }
}

/// Returns the time at which the kernel received a datagram, if the kernel stamps it.
fn stamp(message: &RecvMsg<'_, '_, SockaddrIn>) -> Option<SystemTime> {
    let stamp = message.cmsgs().ok()?.find_map(|control| {
        let ControlMessageOwned::ScmTimestampns(stamp) = control else {
            return None;
        };
        Some(stamp)
    })?;
    let seconds = u64::try_from(stamp.tv_sec()).ok()?;
    let nanos = u32::try_from(stamp.tv_nsec()).ok()?;
    UNIX_EPOCH.checked_add(Duration::new(seconds, nanos))
}

/// Sends up to [`AT_ONCE`] messages to one target. Returns the number of sent messages, which is
/// smaller if the system refuses the message behind them.
///
/// # Errors
/// The error of the system for the first message.
pub(crate) fn send(
    socket: impl AsFd,
    target: SocketAddr,
    messages: &[OutgoingMessage<'_>],
) -> io::Result<usize> {
    let target = SocketAddrAny::from(target);
    let slices = messages.iter().map(|message| [IoSlice::new(message.bytes)]);
    send_slices(socket, Some(&target), slices)
}

/// Sends up to [`AT_ONCE`] messages through a bound socket, each behind the bytes of a header.
/// Returns the number of sent messages, as [`send`].
///
/// # Errors
/// The error of the system for the first message.
pub(crate) fn send_behind(
    socket: impl AsFd,
    header: &[u8],
    messages: &[OutgoingMessage<'_>],
) -> io::Result<usize> {
    let slices = messages
        .iter()
        .map(|message| [IoSlice::new(header), IoSlice::new(message.bytes)]);
    send_slices(socket, None, slices)
}

/// Sends up to [`AT_ONCE`] messages, each in `N` parts.
fn send_slices<'m, const N: usize>(
    socket: impl AsFd,
    target: Option<&SocketAddrAny>,
    messages: impl Iterator<Item = [IoSlice<'m>; N]>,
) -> io::Result<usize> {
    let slices: Vec<[IoSlice<'_>; N]> = messages.take(AT_ONCE).collect();
    let mut controls: Vec<SendAncillaryBuffer<'_, '_, '_>> = slices
        .iter()
        .map(|_| SendAncillaryBuffer::default())
        .collect();
    let headers = slices.iter().zip(&mut controls);
    let mut headers: Vec<MMsgHdr<'_>> = headers
        .map(|(slices, control)| match target {
            Some(target) => MMsgHdr::new_with_addr(target, slices, control),
            None => MMsgHdr::new(slices, control),
        })
        .collect();
    Ok(sendmmsg(socket, &mut headers, SendFlags::DONTWAIT)?)
}
