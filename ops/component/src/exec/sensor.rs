//! A program of the user that measures values: a JSON object in each line of its output.

use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use serde_json::Value as Json;
use skills::{Component, ExecSource, Measured, ValueSensor, ValueSource};
use tokio::io::BufReader;

use super::{KilledGroup, LastLine, group_of, log, next_line, start};

/// Replaces the description of programs by sensors. Values of the same program share a process.
pub(super) fn with_sensors(component: &mut Component) {
    let mut programs: Vec<Arc<ProgramSensor>> = Vec::new();
    for value in &mut component.values {
        let ValueSource::Exec(source) = &value.source else {
            continue;
        };
        let known = programs.iter().find(|known| known.source == *source);
        let program = match known {
            Some(known) => Arc::clone(known),
            None => {
                let new = Arc::new(ProgramSensor {
                    source: source.clone(),
                });
                programs.push(Arc::clone(&new));
                new
            }
        };
        value.source = ValueSource::Sensor(program);
    }
}

#[derive(Debug)]
struct ProgramSensor {
    source: ExecSource,
}

#[async_trait]
impl ValueSensor for ProgramSensor {
    async fn measure(&self, _period: Duration, out: &Measured) -> String {
        let ExecSource {
            command, folder, ..
        } = &self.source;
        let mut child = match start(command, folder, [Stdio::null, Stdio::piped]) {
            Ok(child) => child,
            Err(why) => return why,
        };
        let _group = KilledGroup(group_of(&child));
        let failed = |why: &str| format!("{}: {why}", self.source());
        let (Some(output), Some(errors)) = (child.stdout.take(), child.stderr.take()) else {
            return failed("its output is not connected");
        };
        let logging = async {
            log(&self.source(), BufReader::new(errors), &LastLine::default()).await;
            std::future::pending::<()>().await;
        };
        let measuring = async {
            let mut output = BufReader::new(output);
            let mut line = Vec::new();
            loop {
                match next_line(&mut output, &mut line).await {
                    Ok(Some(text)) => {
                        if let Err(why) = take(&text, out) {
                            return failed(&why);
                        }
                    }
                    Ok(None) => return failed("it has ended"),
                    Err(why) => return failed(&why),
                }
            }
        };
        tokio::select! {
            why = measuring => why,
            () = logging => failed("its output is not connected"),
        }
    }

    fn source(&self) -> String {
        self.source.command.first().cloned().unwrap_or_default()
    }

    fn within(&self, _period: Duration) -> Duration {
        self.source.within
    }
}

/// Takes a line: `{"values": {"Heat": 21.5}}` or `{"fault": "no probe"}`.
fn take(text: &str, out: &Measured) -> Result<(), String> {
    let shown: String = text.chars().take(80).collect();
    let wrong = |why: &str| Err(format!("its line `{shown}` {why}"));
    let Ok(Json::Object(line)) = serde_json::from_str(text) else {
        return wrong("is not a JSON object");
    };
    let mut keys = line.iter();
    match (keys.next(), keys.next()) {
        (Some((key, Json::Object(values))), None) if key == "values" => {
            out.touch();
            for (name, value) in values {
                out.put_json(name, value);
            }
            Ok(())
        }
        (Some((key, Json::String(why))), None) if key == "fault" => {
            out.put_fault(why);
            Ok(())
        }
        _ => wrong("has neither an object `values` nor a text `fault`"),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use skills::LiveValue;
    use skills::server::{ComponentServer, ServeSettings};

    use super::super::with_programs;
    use super::*;

    fn served(script: &str) -> (ComponentServer, std::path::PathBuf) {
        let name = std::thread::current()
            .name()
            .unwrap_or("x")
            .replace(':', "-");
        let folder = std::env::temp_dir().join(format!("sensor-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("run.sh"), script).unwrap();
        let exec = "exec: {command: [/bin/sh, run.sh], within: 2 s}";
        let text = format!(
            "component: x\napplication_uri: urn:x\nnamespace: 1\nvalues:\n  - {{name: Heat, type: Double, {exec}}}\n  - {{name: Count, type: UInt32, {exec}}}\n"
        );
        let component = Component::from_yaml(&text, Path::new(&folder))
            .unwrap_or_else(|findings| panic!("{}", findings.render("x", &text)));
        let component = with_programs(component);
        let built =
            ComponentServer::build(&component, &ServeSettings::default(), |_, _| Vec::new());
        (built.unwrap(), folder)
    }

    async fn until(
        value: &LiveValue,
        wanted: impl Fn(&Result<skills::SkillValue, skills::UnknownValue>) -> bool,
    ) {
        let mut readings = value.watch();
        let found = readings.wait_for(|reading| wanted(&reading.value));
        let found = tokio::time::timeout(Duration::from_secs(30), found).await;
        if found.is_err() {
            panic!("{}: {:?}", value.facts().name, value.reading());
        }
    }

    fn is_lost(
        why: &'static str,
    ) -> impl Fn(&Result<skills::SkillValue, skills::UnknownValue>) -> bool {
        move |value| {
            value
                .as_ref()
                .is_err_and(|found| found.to_string().contains(why))
        }
    }

    #[tokio::test]
    async fn one_process_measures_several_values_until_it_ends_and_is_started_again() {
        let script =
            "echo '{\"values\": {\"Heat\": '$$', \"Count\": '$$', \"Other\": true}}'; sleep 100";
        let (served, folder) = served(script);
        let [heat, count] = served.values() else {
            panic!("{:?}", served.values())
        };
        let process = |value: &LiveValue| value.reading().value.ok().and_then(|of| of.as_f64());
        until(count, |value| {
            let count = value.as_ref().ok().and_then(skills::SkillValue::as_f64);
            count.is_some() && count == process(heat)
        })
        .await;
        let first = process(heat);
        until(heat, is_lost("has measured nothing for 2s")).await;
        until(heat, |value| {
            value.as_ref().is_ok_and(|now| now.as_f64() != first)
        })
        .await;
        served.stop().await;
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[tokio::test]
    async fn a_fault_and_wrong_lines_are_the_reasons_of_unknown_values() {
        for (script, why) in [
            ("echo '{\"fault\": \"no probe\"}'; sleep 100", "no probe"),
            (
                "echo '{\"values\": {\"Heat\": null}}'; sleep 100",
                "does not know",
            ),
            (
                "echo '{\"values\": {\"Heat\": \"hot\"}}'; sleep 100",
                "expected Double, found",
            ),
            ("echo hot; sleep 100", "its line `hot` is not a JSON object"),
            (
                "echo '{\"value\": 1}'; sleep 100",
                "neither an object `values`",
            ),
            ("exit 0", "it has ended"),
        ] {
            let (served, folder) = served(script);
            until(&served.values()[0], is_lost(why)).await;
            served.stop().await;
            std::fs::remove_dir_all(folder).unwrap();
        }
    }
}
