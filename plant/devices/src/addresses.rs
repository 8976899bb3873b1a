//! The addresses of devices in YAML: hosts, lines, units, registers and aliases.

use skills::yaml::{DocumentNode, YamlFindingCode, YamlReader};

use crate::line::ModbusLine;

/// Reads the name of a device as it is used in a path.
pub(crate) fn read_alias<'n>(
    node: &'n DocumentNode,
    reader: &mut YamlReader<'_>,
) -> Option<&'n str> {
    let text = reader.text(node, "the alias of a device")?;
    let fits = !text.is_empty()
        && text.len() <= 64
        && text
            .bytes()
            .all(|b| b.is_ascii_alphanumeric() || b"-_.".contains(&b));
    if fits {
        return Some(text);
    }
    let message = "the alias of a device has letters, digits, -, _ and . only".to_owned();
    reader.refuse(node, YamlFindingCode::WrongValue, message)
}

/// Reads `host:port`.
pub(crate) fn read_address<'n>(
    node: &'n DocumentNode,
    reader: &mut YamlReader<'_>,
) -> Option<&'n str> {
    let text = reader.text(node, "host:port")?;
    if format!("tcp://{text}").parse::<ModbusLine>().is_ok() {
        return Some(text);
    }
    reader.refuse(
        node,
        YamlFindingCode::WrongValue,
        format!("expected host:port, found `{text}`"),
    )
}

/// Reads the number of a Modbus register.
pub(crate) fn read_register(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<u16> {
    let text = reader.text(node, "the number of a register")?;
    let register = text.parse().ok();
    register.or_else(|| {
        let message = format!("expected a number from 0 to 65535, found `{text}`");
        reader.refuse(node, YamlFindingCode::WrongValue, message)
    })
}

/// Reads the line of a Modbus device.
pub(crate) fn read_line(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<ModbusLine> {
    let text = reader.text(node, "where the device is")?;
    match text.parse() {
        Ok(line) => Some(line),
        Err(error) => reader.refuse(node, YamlFindingCode::WrongValue, format!("{error}")),
    }
}

/// Reads the unit of a Modbus device, 1 to 247.
pub(crate) fn read_unit(node: &DocumentNode, reader: &mut YamlReader<'_>) -> Option<u8> {
    let text = reader.text(node, "the number of a unit")?;
    let unit = text.parse().ok().filter(|unit| (1..=247).contains(unit));
    unit.or_else(|| {
        let message = format!("expected a number from 1 to 247, found `{text}`");
        reader.refuse(node, YamlFindingCode::WrongValue, message)
    })
}
