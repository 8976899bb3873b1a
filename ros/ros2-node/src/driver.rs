//! Runs the event loop of RustDDS in the runtime of the bridge instead of in its own thread.
//!
//! A sample then passes through the bridge without waking another thread: its datagram, the reader,
//! the router and the writer are handled in sequence. Waking a thread costs 30 us and more, several
//! times the cost of all other work.

use std::future::poll_fn;
use std::os::fd::OwnedFd;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll, Wake, Waker};
use std::time::Duration;

use futures_util::task::AtomicWaker;
use rustdds::{EventLoop, Turned};
use rustix::io::Errno;
use rustix::time::{
    Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec, timerfd_create,
    timerfd_settime,
};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::task::JoinHandle;
use tokio::time::{Instant, Sleep};

/// Runs the event loop in a task of the current runtime until its participant is dropped. The task
/// returns the reason for its end.
///
/// # Errors
/// If the runtime cannot watch the sockets.
pub(crate) fn spawn(event_loop: EventLoop) -> std::io::Result<JoinHandle<&'static str>> {
    let task = Arc::new(AtomicWaker::new());
    let watch = |descriptor: OwnedFd| {
        let watched = watched(descriptor)?;
        Ok::<_, std::io::Error>(Watched::new(watched, Arc::clone(&task)))
    };
    let sockets: Result<Vec<_>, std::io::Error> = event_loop
        .descriptors()
        .into_iter()
        .map(|descriptor| watch(descriptor.try_clone_to_owned()?))
        .collect();
    let (alarm, rings) = Alarm::new()?;
    let driver = Driver {
        sockets: sockets?,
        rings: watch(rings)?,
        alarm,
        task,
        event_loop,
    };
    Ok(tokio::spawn(driver.run()))
}

#[expect(
    deprecated,
    reason = "what replaces it is unsafe, for types that change or close their descriptor; an OwnedFd does neither"
)]
fn watched(socket: OwnedFd) -> std::io::Result<AsyncFd<OwnedFd>> {
    AsyncFd::with_interest(socket, Interest::READABLE)
}

struct Driver {
    event_loop: EventLoop,
    /// The descriptors of the event loop, each watched by the runtime directly: a nested poll wakes
    /// a thread late.
    sockets: Vec<Watched>,
    /// For deadlines that the timer of the runtime would miss.
    alarm: Alarm,
    /// The descriptor of the alarm.
    rings: Watched,
    /// The waker that the bells of the sockets call.
    task: Arc<AtomicWaker>,
}

/// A descriptor with a flag that shows whether a poll is worthwhile: polling the runtime for each
/// descriptor at each wake took a tenth of the cost of a sample.
struct Watched {
    socket: AsyncFd<OwnedFd>,
    bell: Arc<Bell>,
    waker: Waker,
}

impl Watched {
    fn new(socket: AsyncFd<OwnedFd>, task: Arc<AtomicWaker>) -> Self {
        let bell = Arc::new(Bell {
            // The first poll registers the descriptor with the runtime.
            rung: AtomicBool::new(true),
            task,
        });
        Self {
            socket,
            waker: Waker::from(Arc::clone(&bell)),
            bell,
        }
    }
}

impl Watched {
    /// Returns whether the descriptor is readable, and clears that; the task is woken when it is
    /// readable again.
    fn poll(&self) -> Sockets {
        if !self.bell.rung.swap(false, Ordering::Acquire) {
            return Sockets::Quiet;
        }
        let mut cx = Context::from_waker(&self.waker);
        match self.socket.poll_read_ready(&mut cx) {
            Poll::Ready(Ok(mut ready)) => {
                // Cleared before the turn, so that data that arrives during it is noticed.
                ready.clear_ready();
                // For the next poll, which registers the descriptor again.
                self.bell.rung.store(true, Ordering::Release);
                Sockets::Readable
            }
            Poll::Ready(Err(_shutting_down)) => Sockets::Gone,
            Poll::Pending => Sockets::Quiet,
        }
    }
}

struct Bell {
    rung: AtomicBool,
    task: Arc<AtomicWaker>,
}

impl Wake for Bell {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.rung.store(true, Ordering::Release);
        self.task.wake();
    }
}

impl Driver {
    async fn run(mut self) -> &'static str {
        let mut timer = Box::pin(tokio::time::sleep(Duration::ZERO));
        loop {
            let now = Instant::now();
            let timeout = self.event_loop.timeout();
            let due = if timeout < COARSE {
                now + timeout
            } else {
                idle_ticks::next(now, timeout)
            };
            let rings = timeout < SHORT && self.alarm.ring_at(due, now).is_ok();
            // Only an earlier deadline needs the timer wheel; a later deadline is detected when the
            // timer fires. An elapsed timer is ready at each poll, also while the alarm is set.
            if timer.is_elapsed() || !rings && due < timer.deadline() {
                timer.as_mut().reset(due);
            }
            if !poll_fn(|cx| self.poll_wake(timer.as_mut(), cx)).await {
                return "the runtime has ended";
            }
            let mut turns = 0_u32;
            loop {
                match self.event_loop.turn() {
                    Turned::Done => break,
                    Turned::Unfinished => {}
                    Turned::Ended => return "the participant has left the domain",
                    Turned::Failed(why) => return why,
                }
                turns = turns.saturating_add(1);
                if turns == 1 {
                    let_others_run().await;
                } else {
                    tokio::task::yield_now().await;
                }
                // A socket that is never empty must not delay the other sockets.
                poll_fn(|cx| Poll::Ready(self.poll_sockets(cx))).await;
            }
            // Commands and datagrams may arrive without end; other tasks get their turn here.
            tokio::task::consume_budget().await;
        }
    }

    /// Returns ready when the event loop has work; false if the runtime ends.
    fn poll_wake(&mut self, timer: Pin<&mut Sleep>, cx: &mut Context<'_>) -> Poll<bool> {
        let rung = self.event_loop.poll_commands(cx).is_ready();
        match self.poll_sockets(cx) {
            Sockets::Readable => Poll::Ready(true),
            Sockets::Quiet if rung || timer.poll(cx).is_ready() => Poll::Ready(true),
            Sockets::Quiet => Poll::Pending,
            Sockets::Gone => Poll::Ready(false),
        }
    }

    /// Passes the readable sockets to the event loop; the task is woken when another socket becomes
    /// readable.
    fn poll_sockets(&mut self, cx: &mut Context<'_>) -> Sockets {
        // Registered before the bells are read, so that no wake is missed.
        self.task.register(cx.waker());
        let mut found = Sockets::Quiet;
        for (index, watched) in self.sockets.iter().enumerate() {
            match watched.poll() {
                Sockets::Readable => {
                    self.event_loop.readable(index);
                    found = Sockets::Readable;
                }
                Sockets::Quiet => {}
                Sockets::Gone => return Sockets::Gone,
            }
        }
        match self.rings.poll() {
            Sockets::Quiet => found,
            rung @ (Sockets::Readable | Sockets::Gone) => rung,
        }
    }
}

/// A timer of the system. The timer of the runtime counts in milliseconds and fires up to two of
/// them late; the rounds of fragments of a large sample are a fraction of that apart.
struct Alarm {
    timer: OwnedFd,
    /// The time of the next ring.
    at: Option<Instant>,
}

impl Alarm {
    /// Creates an alarm, and returns a descriptor that becomes readable when it rings.
    fn new() -> std::io::Result<(Self, OwnedFd)> {
        let flags = TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC;
        let timer = timerfd_create(TimerfdClockId::Monotonic, flags)?;
        let rings = timer.try_clone()?;
        Ok((Self { timer, at: None }, rings))
    }

    /// Sets the alarm, unless it rings earlier anyway.
    fn ring_at(&mut self, due: Instant, now: Instant) -> Result<(), Errno> {
        if self.at.is_some_and(|at| now < at && at <= due) {
            return Ok(());
        }
        // Zero would switch it off.
        let left = due
            .saturating_duration_since(now)
            .max(Duration::from_nanos(1));
        let it_value = Timespec::try_from(left).map_err(|_too_long| Errno::INVAL)?;
        let once = Itimerspec {
            it_interval: Timespec::default(),
            it_value,
        };
        timerfd_settime(&self.timer, TimerfdTimerFlags::empty(), &once)?;
        self.at = Some(due);
        Ok(())
    }
}

/// Deadlines that are further away are met up to a tick late. They belong to heartbeats, leases and
/// clean-ups, which last for seconds.
const COARSE: Duration = Duration::from_millis(500);
/// Deadlines that are nearer are set by the alarm.
const SHORT: Duration = Duration::from_millis(2);

/// Runs the ready tasks without the poll of the sockets that [`yield_now`](tokio::task::yield_now)
/// performs: a system call for each sample.
async fn let_others_run() {
    let mut ran = false;
    poll_fn(|cx| {
        if std::mem::replace(&mut ran, true) {
            return Poll::Ready(());
        }
        cx.waker().wake_by_ref();
        Poll::Pending
    })
    .await;
}

enum Sockets {
    Readable,
    Quiet,
    /// The runtime has ended.
    Gone,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_alarm_rings_within_a_fraction_of_a_millisecond_again_and_again() {
        let (mut alarm, rings) = Alarm::new().unwrap();
        let rings = watched(rings).unwrap();
        let mut took = Vec::new();
        for turn in 0..500 {
            let now = Instant::now();
            alarm
                .ring_at(now + Duration::from_micros(300), now)
                .unwrap();
            // A later deadline does not postpone it.
            alarm.ring_at(now + Duration::from_secs(60), now).unwrap();
            let ready = tokio::time::timeout(Duration::from_secs(10), rings.readable());
            ready.await.unwrap().unwrap().clear_ready();
            took.push(now.elapsed());
            if turn >= 20 && took.iter().any(|took| *took < Duration::from_millis(1)) {
                break;
            }
        }
        assert!(took.iter().all(|took| *took >= Duration::from_micros(300)));
        // The machine may be busy; the timer of the runtime needs a millisecond each time.
        let fastest = took.iter().min().unwrap();
        assert!(*fastest < Duration::from_millis(1), "{took:?}");
    }
}
