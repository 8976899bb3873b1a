//! The file of the job orders. The whole file is rewritten before a change is acknowledged.

use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use plant_opcua::job_control::JobOrder;
use serde::{Deserialize, Serialize};
use tracing::warn;

use crate::job_order::{JobProgress, KeptJobOrder, MOST_ORDERS, OrderState};

/// An open file of job orders.
#[derive(Debug)]
pub(crate) struct OrderFile {
    folder: PathBuf,
}

/// A job order in the file.
#[derive(Debug, Serialize, Deserialize)]
struct Stored {
    id: String,
    process: String,
    state: OrderState,
    reason: Option<String>,
    progress: Option<JobProgress>,
    /// The job order in the binary encoding of OPC UA.
    order: Vec<u8>,
}

impl OrderFile {
    /// Opens the file of a folder, and restores its job orders. A file that cannot be read is set
    /// aside with a warning.
    ///
    /// # Errors
    /// Fails if the disk cannot be read or written.
    pub(crate) fn open(folder: &Path) -> io::Result<(Self, Vec<KeptJobOrder>)> {
        let file = Self {
            folder: folder.to_owned(),
        };
        let path = folder.join(NAME);
        let bytes = match fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok((file, Vec::new())),
            Err(error) => return Err(error),
        };
        match restored(&bytes) {
            Ok(orders) => Ok((file, orders)),
            Err(why) => {
                let damaged = folder.join(DAMAGED);
                fs::rename(&path, &damaged)?;
                let damaged = damaged.display();
                warn!("the job orders cannot be read and are in {damaged}: {why}");
                Ok((file, Vec::new()))
            }
        }
    }

    /// Writes all job orders, and returns when they are on the disk.
    ///
    /// # Errors
    /// Fails if the disk is full or broken; then the file is as before.
    pub(crate) fn write(&self, orders: &[KeptJobOrder]) -> io::Result<()> {
        let stored = orders.iter().map(|order| Stored {
            id: order.order.id.as_ref().to_owned(),
            process: order.process.clone(),
            state: order.state,
            reason: order.reason.clone(),
            progress: order.progress.clone(),
            order: order.order.to_bytes(),
        });
        let stored: Vec<Stored> = stored.collect();
        let new = self.folder.join(NEW);
        let mut file = File::create(&new)?;
        file.write_all(&serde_json::to_vec(&stored)?)?;
        file.sync_all()?;
        fs::rename(&new, self.folder.join(NAME))?;
        File::open(&self.folder)?.sync_all()
    }
}

fn restored(bytes: &[u8]) -> Result<Vec<KeptJobOrder>, String> {
    let stored: Vec<Stored> = serde_json::from_slice(bytes).map_err(|error| error.to_string())?;
    if stored.len() > MOST_ORDERS {
        return Err(format!("it has more than {MOST_ORDERS} orders"));
    }
    let orders = stored.into_iter().map(|stored| {
        let order = JobOrder::from_bytes(&stored.order);
        let order = order.map_err(|why| format!("{}: {why}", stored.id))?;
        Ok(KeptJobOrder::restored(
            (order, stored.process),
            stored.state,
            (stored.progress, stored.reason),
        ))
    });
    orders.collect()
}

const NAME: &str = "job-orders.json";
const NEW: &str = "job-orders.json.new";
const DAMAGED: &str = "job-orders.json.damaged";
