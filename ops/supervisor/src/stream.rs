//! Server-sent events: each event is made when the browser takes it.

use std::convert::Infallible;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use hyper::body::{Body, Frame};
use tokio::time::{Interval, MissedTickBehavior, interval};

use crate::page::Page;
use crate::view::{View, Viewer};

/// The event stream of a browser. The connection polls it only while the browser reads, so a
/// browser that does not read holds one event at most.
pub(crate) struct Events {
    page: Arc<Page>,
    viewer: Viewer,
    ticks: Interval,
    is_begun: bool,
}

impl Events {
    pub(crate) fn new(page: Arc<Page>, view: View) -> Self {
        let mut ticks = interval(view.period());
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        page.came();
        Self {
            page,
            viewer: Viewer::new(view),
            ticks,
            is_begun: false,
        }
    }
}

impl Drop for Events {
    fn drop(&mut self) {
        self.page.left();
    }
}

impl Body for Events {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        let this = self.get_mut();
        if !this.is_begun {
            this.is_begun = true;
            let retry = Bytes::from_static(b"retry: 2000\n\n");
            return Poll::Ready(Some(Ok(Frame::data(retry))));
        }
        loop {
            ready!(this.ticks.poll_tick(cx));
            if let Some(event) = this.page.next_event(&mut this.viewer) {
                return Poll::Ready(Some(Ok(Frame::data(event.into()))));
            }
        }
    }
}
