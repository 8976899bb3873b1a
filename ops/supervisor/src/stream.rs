//! Server-sent events: each event is made when the browser has taken the event before.

use std::convert::Infallible;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use bytes::Bytes;
use hyper::body::{Body, Frame};
use tokio::runtime::{Builder, Handle};
use tokio::sync::{mpsc, oneshot};
use tokio::time::{MissedTickBehavior, interval};

use crate::page::Page;
use crate::session::EventStreamBrowser;
use crate::view::{BrowserView, Viewer};

/// The thread that makes events and reads the status of programs, so that browsers delay
/// samples only while an event is made. It ends when this value is dropped.
#[derive(Debug)]
pub(crate) struct Worker {
    handle: Handle,
    _stop: oneshot::Sender<()>,
}

impl Worker {
    /// Starts the thread.
    ///
    /// # Errors
    /// The system refuses another thread.
    pub(crate) fn start() -> io::Result<Self> {
        let runtime = Builder::new_current_thread().enable_all().build()?;
        let handle = runtime.handle().clone();
        let (stop, stopped) = oneshot::channel::<()>();
        let run = move || {
            // The sender is dropped at the end.
            let _dropped = runtime.block_on(stopped);
        };
        drop(
            std::thread::Builder::new()
                .name("page".to_owned())
                .spawn(run)?,
        );
        Ok(Self {
            handle,
            _stop: stop,
        })
    }

    /// Runs a task in the thread.
    pub(crate) fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) {
        drop(self.handle.spawn(task));
    }
}

/// The event stream of a browser. It holds one event at most, for a browser that does not read.
pub(crate) struct Events(mpsc::Receiver<Bytes>);

impl Events {
    /// Starts the stream of a view.
    pub(crate) fn start(
        worker: &Worker,
        page: Arc<Page>,
        view: BrowserView,
        reader: EventStreamBrowser,
    ) -> Self {
        let (events, taken) = mpsc::channel(1);
        worker.spawn(make(page, view, reader, events));
        Self(taken)
    }
}

/// Makes events until the browser has left, or its session has ended.
async fn make(
    page: Arc<Page>,
    view: BrowserView,
    reader: EventStreamBrowser,
    events: mpsc::Sender<Bytes>,
) {
    let mut ticks = interval(view.period());
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut viewer = Viewer::new(view);
    page.came();
    let retry = Bytes::from_static(b"retry: 2000\n\n");
    let mut is_there = events.send(retry).await.is_ok();
    while is_there && page.may_read(&reader) {
        ticks.tick().await;
        is_there = match events.reserve().await {
            Ok(free) => {
                if let Some(event) = page.next_event(&mut viewer) {
                    free.send(event.into());
                }
                !events.is_closed()
            }
            Err(_) => false,
        };
    }
    page.left();
}

impl Body for Events {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        let next = self.get_mut().0.poll_recv(cx);
        next.map(|event| event.map(|event| Ok(Frame::data(event))))
    }
}
