//! Statements of graphs as documents, without a query: in few places, with limits of time and size.

use std::io::{self, BufWriter, Write};
use std::time::Duration;

use bytes::Bytes;
use http_body_util::Full;
use hyper::{Response, StatusCode};
use tokio::sync::OwnedSemaphorePermit;
use tokio::time::Instant;

use crate::http::{HttpRefusal, ServedSite, content_of};
use crate::query::QueryFault;
use crate::writes::failed;
use crate::written::Bounded;

/// The document of a dump, with limits of its size and of the time until it is complete.
pub(crate) struct DumpWriter {
    document: Bounded,
    until: Instant,
}

impl Write for DumpWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if Instant::now() >= self.until {
            return Err(io::ErrorKind::TimedOut.into());
        }
        self.document.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The document of a dump, which keeps its place until it is sent.
struct PlacedDump {
    document: Vec<u8>,
    _place: OwnedSemaphorePermit,
}

impl AsRef<[u8]> for PlacedDump {
    fn as_ref(&self) -> &[u8] {
        &self.document
    }
}

impl ServedSite {
    /// Answers with a document that `write` writes on a thread of its own. Returns `None` if
    /// `write` has nothing to write.
    ///
    /// # Errors
    /// All places are in use, the document is too large or takes too long, or `write` fails.
    pub(crate) async fn dumped<F>(
        &self,
        media: &'static str,
        write: F,
    ) -> Result<Option<Response<Full<Bytes>>>, HttpRefusal>
    where
        F: FnOnce(&mut BufWriter<DumpWriter>) -> io::Result<Option<()>> + Send + 'static,
    {
        let place = tokio::time::timeout(WAIT, self.queries.dump_place()).await;
        let Ok(Ok(place)) = place else {
            let why = "other graphs are being read; ask again";
            return Err(HttpRefusal::new(
                StatusCode::SERVICE_UNAVAILABLE,
                "busy",
                why,
            ));
        };
        let limits = self.queries.limits();
        let written = tokio::task::spawn_blocking(move || {
            // A text is written in many small parts.
            let mut to = BufWriter::new(DumpWriter {
                document: Bounded::new(limits.dump),
                until: Instant::now() + limits.time,
            });
            let written = write(&mut to)?;
            let to = to.into_inner().map_err(io::IntoInnerError::into_error)?;
            Ok(written.map(|()| PlacedDump {
                document: to.document.bytes,
                _place: place,
            }))
        });
        let written: io::Result<Option<PlacedDump>> =
            written.await.map_err(|error| failed(&error))?;
        match written {
            Ok(written) => Ok(written.map(|dump| content_of(media, Bytes::from_owner(dump)))),
            Err(error) if error.kind() == io::ErrorKind::FileTooLarge => {
                let why = format!(
                    "the statements take more than {} bytes; read fewer of them, by ?graph=IRI or a \
                     query",
                    limits.dump
                );
                let status = StatusCode::INSUFFICIENT_STORAGE;
                Err(HttpRefusal::new(status, "result_limit", &why))
            }
            Err(error) if error.kind() == io::ErrorKind::TimedOut => {
                let limit = limits.time;
                Err(QueryFault::Time { limit }.into())
            }
            Err(error) => Err(failed(&error)),
        }
    }
}

/// Number of dumps at a time, each of which is in memory until it is sent.
pub(crate) const DUMPS: usize = 2;
/// Time to wait for a place.
const WAIT: Duration = Duration::from_secs(2);
