//! `ua-space aas`: the asset administration shell (AAS V3) of a process module, from its manifest,
//! as JSON or as a package (AASX).

mod elements;
mod package;
mod submodels;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Write as _};

use mtp::{Family, Module, VariableLink};
use serde_json::{Value, json};

use crate::arguments::AasArguments;
use crate::exit::CommandFailure;
use crate::input;
use crate::live::harmless;
use crate::manifest::read;
use crate::report::warn;
use crate::source::plain_name;

use elements::{ShortNames, reference};

/// Runs `ua-space aas`.
pub(crate) fn aas(arguments: &AasArguments) -> Result<(), CommandFailure> {
    if arguments.aasx.is_some() && arguments.file == "-" {
        let why = "--aasx needs the manifest as a file, whose name the package has";
        return Err(CommandFailure::Usage(why.to_owned()));
    }
    let module = read(&arguments.file)?;
    let mut facts = of_module(&module);
    for given in &arguments.nameplate {
        let (key, value) = given.split_once('=').unwrap_or_default();
        let known = submodels::NAMEPLATE.iter().find(|field| field.name == key);
        let Some(field) = known.filter(|_| !value.is_empty()) else {
            let names: Vec<&str> = submodels::NAMEPLATE
                .iter()
                .map(|field| field.name)
                .collect();
            return Err(CommandFailure::Usage(format!(
                "--nameplate {given}: expected NAME=VALUE; the names are {}",
                names.join(", ")
            )));
        };
        facts.insert(field.name, value.to_owned());
    }
    let file = plain_name(&arguments.file)?;
    let id = match &arguments.id {
        Some(id) => id.clone(),
        None => format!("urn:ua-bridge:mtp:{}", mtp::escaped(&file)),
    };
    let (environment, missing) = environment(&module, (&id, &file), &facts);
    if !missing.is_empty() {
        warn(&harmless(&format!(
            "note: the nameplate is left out; it needs --nameplate {}=..",
            missing.join("=.. --nameplate ")
        )));
    }
    let text = serde_json::to_string_pretty(&environment)
        .map_err(|error| CommandFailure::Data(format!("cannot write JSON: {error}")))?;
    let Some(path) = &arguments.aasx else {
        writeln!(io::stdout().lock(), "{text}")?;
        return Ok(());
    };
    let manifest = package::PackagedManifest {
        path: &submodels::package_path(&file),
        content_type: submodels::content_type(&file),
        contents: &input::read(&arguments.file)?,
    };
    let written = package::package(&text, &manifest).and_then(|bytes| {
        let mut to = File::create_new(path)?;
        to.write_all(&bytes)?;
        to.sync_all()
    });
    written.map_err(|error| CommandFailure::Io(format!("cannot write {}: {error}", path.display())))
}

/// Returns the environment of a module with these facts of its nameplate, and the mandatory fields
/// of the nameplate that are missing.
fn environment(
    module: &Module,
    (id, file): (&str, &str),
    facts: &BTreeMap<&'static str, String>,
) -> (Value, Vec<&'static str>) {
    let mut submodels = Vec::new();
    let missing = match submodels::nameplate(id, facts) {
        Ok(nameplate) => {
            submodels.push(nameplate);
            Vec::new()
        }
        Err(missing) => missing,
    };
    submodels.extend([
        submodels::capabilities(id, module),
        submodels::interfaces(id, module),
        submodels::module_type_package(id, file, module),
    ]);
    let references = submodels.iter().filter_map(|submodel| {
        let id = submodel.get("id")?.as_str()?;
        Some(reference("ModelReference", &[("Submodel", id)]))
    });
    let references: Vec<Value> = references.collect();
    let environment = json!({
        "assetAdministrationShells": [{
            "modelType": "AssetAdministrationShell",
            "id": format!("{id}/aas"),
            "idShort": ShortNames::default().of(&module.name),
            "assetInformation": { "assetKind": "Instance", "globalAssetId": id },
            "submodels": references,
        }],
        "submodels": submodels,
    });
    (environment, missing)
}

/// Returns the facts for the nameplate in the information of the module (MTP 2.0).
fn of_module(module: &Module) -> BTreeMap<&'static str, String> {
    let information = module.assemblies.iter();
    let information = information.filter(|one| one.family == Family::Information);
    let mut facts = BTreeMap::new();
    for variable in information.flat_map(|one| &one.variables) {
        let VariableLink::Constant(value) = &variable.link else {
            continue;
        };
        let field = submodels::NAMEPLATE
            .iter()
            .find(|field| field.information.is_some_and(|name| name == variable.name));
        if let Some(field) = field.filter(|_| !value.trim().is_empty()) {
            facts
                .entry(field.name)
                .or_insert_with(|| value.trim().to_owned());
        }
    }
    facts
}

#[cfg(test)]
mod tests {
    use super::*;

    const DOSING: &str = include_str!("../../../examples/plant/dosing.aml");

    fn module() -> Module {
        Module::from_bytes(DOSING.as_bytes()).unwrap()
    }

    /// Returns the elements with an idShort, at any depth.
    fn find<'v>(value: &'v Value, id_short: &str, found: &mut Vec<&'v Value>) {
        match value {
            Value::Object(map) => {
                if map.get("idShort").and_then(Value::as_str) == Some(id_short) {
                    found.push(value);
                }
                map.values().for_each(|value| find(value, id_short, found));
            }
            Value::Array(all) => all.iter().for_each(|value| find(value, id_short, found)),
            Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
        }
    }

    fn found<'v>(value: &'v Value, id_short: &str) -> Vec<&'v Value> {
        let mut all = Vec::new();
        find(value, id_short, &mut all);
        all
    }

    #[test]
    fn a_shell_has_the_submodels_of_its_module() {
        let (all, missing) = environment(&module(), ("urn:x", "dosing.aml"), &BTreeMap::new());
        let ids: Vec<_> = all["submodels"]
            .as_array()
            .unwrap()
            .iter()
            .map(|submodel| submodel["idShort"].as_str().unwrap())
            .collect();
        assert_eq!(
            ids,
            [
                "CapabilityDescription",
                "AssetInterfacesDescription",
                "ModuleTypePackage"
            ]
        );
        let first = &all["assetAdministrationShells"][0];
        assert_eq!(first["submodels"].as_array().unwrap().len(), 3);
        assert!(missing.contains(&"ManufacturerName"), "{missing:?}");
        let amount = found(&all, "Amount");
        assert!(
            amount
                .iter()
                .any(|one| one["modelType"] == "Range" && one["max"] == "5")
        );
        let node = "opc.tcp://127.0.0.1:4855/?id=nsu=urn:example:dosing;s=Dosing.CommandExt";
        assert!(all.to_string().contains(node), "{all}");
    }

    #[test]
    fn a_nameplate_needs_all_mandatory_fields() {
        let fields = submodels::NAMEPLATE.iter();
        let mut facts: BTreeMap<_, _> = fields
            .map(|field| (field.name, "2026".to_owned()))
            .collect();
        let (all, missing) = environment(&module(), ("urn:x", "dosing.aml"), &facts);
        assert_eq!(
            (all["submodels"].as_array().unwrap().len(), missing.len()),
            (4, 0)
        );
        let name = found(&all, "ManufacturerName");
        assert_eq!(
            name[0]["value"][0],
            json!({ "language": "en", "text": "2026" })
        );
        facts.remove("ManufacturerName");
        let (all, missing) = environment(&module(), ("urn:x", "dosing.aml"), &facts);
        assert_eq!(
            (all["submodels"].as_array().unwrap().len(), missing),
            (3, vec!["ManufacturerName"])
        );
    }

    #[test]
    fn short_names_are_valid_and_distinct() {
        let mut names = ShortNames::default();
        let made: Vec<String> = ["a b", "a.b", "1", "", "ä", "Fill"]
            .map(|name| names.of(name))
            .into();
        let is_valid = |name: &String| {
            let mut chars = name.chars();
            chars.next().is_some_and(|c| c.is_ascii_alphabetic())
                && name.len() > 1
                && !name.ends_with('_')
                && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
        };
        assert!(made.iter().all(is_valid), "{made:?}");
        let distinct: std::collections::BTreeSet<_> = made.iter().collect();
        assert_eq!(distinct.len(), made.len(), "{made:?}");
    }
}
