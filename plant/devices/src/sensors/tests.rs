use std::path::Path;
use std::sync::Mutex;

use skills::server::{ComponentServer, ServeSettings};
use skills::{Component, LiveValue, UnknownValue};
use tokio::time::timeout;

use super::*;
use crate::Kinds;
use crate::modbus::server::{LineFaults, RegisterTable, Registers, ServedDevice};

const SOON: Duration = Duration::from_secs(30);

/// A device with the same registers as holding and as input registers.
#[derive(Debug, Default)]
struct Meter(Mutex<[u16; 4]>);

impl Registers for Meter {
    fn read(&self, _table: RegisterTable, address: u16, count: u16) -> Option<Vec<u16>> {
        let registers = self.0.lock().unwrap();
        let first = usize::from(address);
        Some(registers.get(first..first + usize::from(count))?.to_vec())
    }

    fn write(&self, _address: u16, _words: &[u16]) -> bool {
        false
    }
}

fn component(values: &str) -> Result<Component, String> {
    let text = format!("component: x\napplication_uri: urn:x\nnamespace: 1\nvalues:\n{values}");
    Component::from_yaml_with(&text, Path::new(""), &Kinds)
        .map_err(|findings| findings.render("x.yaml", &text))
}

fn served(values: &str) -> ComponentServer {
    let component = component(values).unwrap();
    ComponentServer::build(&component, &ServeSettings::default(), |_, _| Vec::new()).unwrap()
}

async fn until(value: &LiveValue, wanted: impl Fn(&Result<SkillValue, UnknownValue>) -> bool) {
    let mut readings = value.watch();
    let found = timeout(SOON, readings.wait_for(|reading| wanted(&reading.value))).await;
    if found.is_err() {
        panic!("{}: {:?}", value.facts().name, value.reading());
    }
}

#[tokio::test]
async fn registers_are_values_and_are_unknown_while_the_device_is_silent() {
    let meter = Arc::new(Meter(Mutex::new([0x00FA, 0x8001, 0x0000, 0x42F7])));
    let faults = LineFaults::default();
    let line = "tcp://127.0.0.1:0".parse().unwrap();
    let serving = ServedDevice::start(&line, 3, meter.clone(), faults.clone())
        .await
        .unwrap();
    let at = format!("at: \"{}\", unit: 3", serving.line());
    let served = served(&format!(
        "  - {{name: Heat, unit: degC, period: 20 ms, modbus: {{{at}, input: 0, as: int16, scale: 0.1, offset: -5}}}}\n  \
         - {{name: Full, period: 20 ms, modbus: {{{at}, holding: 1, bit: 15}}}}\n  \
         - {{name: Flow, period: 20 ms, modbus: {{{at}, holding: 2, as: float32, low_word_first: true}}}}\n"
    ));
    let [heat, full, flow] = served.values() else {
        panic!("{:?}", served.values())
    };
    until(heat, |value| *value == Ok(SkillValue::Double(20.0))).await;
    until(full, |value| *value == Ok(SkillValue::Boolean(true))).await;
    until(flow, |value| *value == Ok(SkillValue::Float(123.5))).await;
    faults.set_silent(true);
    until(heat, |value| {
        value
            .as_ref()
            .is_err_and(|why| why.to_string().contains("no answer from unit 3"))
    })
    .await;
    meter.0.lock().unwrap()[0] = 0x0032;
    faults.set_silent(false);
    until(heat, |value| *value == Ok(SkillValue::Double(0.0))).await;
    served.stop().await;
}

#[test]
fn numbers_of_process_data_have_their_formats() {
    let number = |format, bit| Number {
        format,
        swapped: false,
        bit,
        scaled: None,
    };
    let bytes = [0xFF, 0x38, 0x00, 0x05];
    assert_eq!(
        number(Format::Int8, None).of(&bytes),
        Ok(SkillValue::SByte(-1))
    );
    assert_eq!(
        number(Format::Int16, None).of(&bytes),
        Ok(SkillValue::Int16(-200))
    );
    assert_eq!(
        number(Format::UInt32, None).of(&bytes),
        Ok(SkillValue::UInt32(0xFF38_0005))
    );
    assert_eq!(
        number(Format::UInt8, Some(3)).of(&bytes[1..]),
        Ok(true.into())
    );
    let short = number(Format::UInt16, None).of(&bytes[3..]).unwrap_err();
    assert_eq!(short.to_string(), "the data have 1 bytes, and 2 are needed");
}

#[test]
fn wrong_sensors_are_findings_with_their_lines() {
    for (source, expected) in [
        ("modbus: {input: 1}", "`at` is missing"),
        ("modbus: {at: \"tcp://h:1\"}", "either `holding` or `input`"),
        (
            "modbus: {at: \"tcp://h:1\", input: 1, as: float16}",
            "expected one of uint8",
        ),
        (
            "modbus: {at: \"tcp://h:1\", input: 1, as: uint8}",
            "a register has 16 bits",
        ),
        (
            "modbus: {at: \"tcp://h:1\", input: 1, bit: 16}",
            "the number of a bit below 16",
        ),
        ("io_link: {alias: a}", "`master` is missing"),
        ("io_link: {master: \"h:1\", byte: 32}", "from 0 to 31"),
    ] {
        let told = component(&format!("  - {{name: A, {source}}}\n")).unwrap_err();
        assert!(
            told.contains(expected) && told.contains("x.yaml:5:"),
            "{told}"
        );
    }
}

/// The values of a device, measured as a component does.
pub(crate) struct MeasuredDevice {
    live: Vec<LiveValue>,
    _task: tokio::task::JoinSet<()>,
}

/// Measures all values of a device every 50 ms.
pub(crate) fn measured(device: Arc<dyn skills::Device>) -> MeasuredDevice {
    let (live, watching) = skills::measure_device(device, Duration::from_millis(50));
    let mut task = tokio::task::JoinSet::new();
    task.spawn(watching);
    MeasuredDevice { live, _task: task }
}

impl MeasuredDevice {
    /// Waits until a value is as wanted.
    pub(crate) async fn until(
        &self,
        name: &str,
        wanted: impl Fn(&Result<SkillValue, UnknownValue>) -> bool,
    ) {
        let live = self.live.iter().find(|live| live.facts().name == name);
        until(live.unwrap(), wanted).await;
    }
}
