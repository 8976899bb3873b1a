//! Mutexes whose state stays usable after a panic.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Locks a mutex.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Each change is complete before the mutex is released, so a poisoned mutex is usable.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
