//! A program for the driver `exec`, in Rust: it closes or opens a simulated gripper.
//!
//! ```yaml
//! driver: {exec: {command: [./own_gripper, grasp]}}
//! ```
//!
//! The lines are defined by `ua-component --schema exec`.

use std::io::{BufRead, Write};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use serde_json::{Value, json};

/// Runs the action of one start: `lines` are the messages of the component, `say` sends messages to
/// it.
pub(crate) fn run(
    action: &str,
    lines: &Receiver<String>,
    mut say: impl FnMut(Value),
) -> Result<(), String> {
    let line = lines.recv().map_err(|_| "there is no start")?;
    let message: Value = serde_json::from_str(&line).map_err(|error| error.to_string())?;
    let start = message
        .get("start")
        .ok_or("the first line is not a start")?;
    let force = start.pointer("/parameters/Force").and_then(Value::as_f64);
    let step = if action == "grasp" { "Close" } else { "Open" };
    let note = format!("force {} N", force.unwrap_or_default());
    say(json!({"step": step, "note": note}));
    for tenth in 1..=10_u8 {
        // The next line is `{"halt": ...}`; the end of the input means the same.
        match lines.recv_timeout(STEP) {
            Err(RecvTimeoutError::Timeout) => {}
            Ok(_) | Err(RecvTimeoutError::Disconnected) => {
                say(json!({"failed": format!("halted at {} %", tenth * 10)}));
                return Ok(());
            }
        }
        say(json!({"progress": f32::from(tenth) / 10.0}));
    }
    let results = match action {
        "grasp" => json!({"Gripped": true}),
        _ => json!({}),
    };
    say(json!({"result": results}));
    Ok(())
}

/// The duration of a tenth of the motion.
const STEP: Duration = Duration::from_millis(100);

#[cfg_attr(test, expect(dead_code, reason = "the test runs the action only"))]
fn main() -> Result<(), String> {
    let action = std::env::args().nth(1).unwrap_or_default();
    let (sender, lines) = channel();
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().lines() {
            let Ok(line) = line else { return };
            if sender.send(line).is_err() {
                return;
            }
        }
    });
    let mut out = std::io::stdout().lock();
    run(&action, &lines, |message| {
        // A message without a reader means that the component has ended.
        let _written = writeln!(out, "{message}").and_then(|()| out.flush());
    })
}
