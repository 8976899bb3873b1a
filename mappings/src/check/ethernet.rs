//! UADP over Ethernet.

use super::network::interface;
use crate::code::Code;
use crate::document::EthernetEntry;
use crate::ethernet::{EthernetGroup, EthernetUrl, EthernetUrlFault};
use crate::findings::MappingFindings;
use crate::read::{OptionalKey, given, short};
use crate::tree::TextSpan;

/// Returns the group of an entry; `None` for a faulty entry.
pub(super) fn group(
    entry: &EthernetEntry,
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<EthernetGroup> {
    let interface = name(entry, place, findings);
    let url = match given(&entry.address) {
        None if entry.address.is_some() => None,
        None => Some(EthernetUrl {
            address: EthernetGroup::ADDRESS,
            vlan: None,
            priority: None,
        }),
        Some((text, place)) => address(text, place, findings),
    };
    let vlan = number(&entry.vlan, ("VLAN", EthernetGroup::VLANS), findings);
    let priority = number(
        &entry.priority,
        ("priority", EthernetGroup::PRIORITIES),
        findings,
    );
    let url = url?;
    for (is_twice, key, field) in [
        (url.vlan.is_some(), "vlan", &entry.vlan),
        (url.priority.is_some(), "priority", &entry.priority),
    ] {
        if let Some(at) = field.as_ref().filter(|_| is_twice) {
            let message = format!("`address` has the {key} already");
            let note = findings.error(Code::Carriers, at.place, message);
            note.help("remove it here or there");
        }
    }
    let priority = priority.and_then(|priority| u8::try_from(priority).ok());
    Some(EthernetGroup {
        interface: interface?,
        address: url.address,
        vlan: url.vlan.or(vlan),
        priority: url.priority.or(priority),
    })
}

/// Returns the name of the interface.
fn name(entry: &EthernetEntry, place: TextSpan, findings: &mut MappingFindings) -> Option<String> {
    let Some(at) = &entry.interface else {
        let message = "Ethernet needs the `interface`";
        let note = findings.error(Code::MissingKey, place, message);
        note.help("use a name of `ip -brief link`, such as interface: eth0");
        return None;
    };
    let name = interface(at.value.as_deref()?, at.place, findings)?;
    if name.parse::<std::net::IpAddr>().is_ok() {
        let message = format!("`{}` is not the name of an interface", short(&name));
        let note = findings.error(Code::Interface, at.place, message);
        note.help("use a name of `ip -brief link`, such as eth0");
        return None;
    }
    Some(name)
}

fn address(text: &str, place: TextSpan, findings: &mut MappingFindings) -> Option<EthernetUrl> {
    let fault = match EthernetUrl::parse(text) {
        Ok(url) => return Some(url),
        Err(fault) => fault,
    };
    let shown = short(text);
    let message = match fault {
        EthernetUrlFault::Form => format!("`{shown}` is not a MAC address"),
        EthernetUrlFault::Unusable => {
            format!(
                "`{shown}` is neither a host nor a group of 01-00-5E-00-00-00 to 01-00-5E-7F-FF-FF"
            )
        }
        EthernetUrlFault::Vlan => format!("the VLAN of `{shown}` is not 1 to 4094"),
        EthernetUrlFault::Priority => format!("the priority of `{shown}` is not 0 to 7"),
    };
    let note = findings.error(Code::Address, place, message);
    note.help(format!(
        "use an address such as {group} or opc.eth://{group}:5.6",
        group = EthernetGroup::ADDRESS
    ));
    None
}

fn number(
    field: &OptionalKey<u16>,
    (what, range): (&str, std::ops::RangeInclusive<u16>),
    findings: &mut MappingFindings,
) -> Option<u16> {
    let (number, place) = given(field)?;
    if range.contains(number) {
        return Some(*number);
    }
    let message = format!("the {what} {number} is out of range");
    let (least, most) = range.into_inner();
    findings
        .error(Code::WrongValue, place, message)
        .label(format!("{least} to {most}"));
    None
}
