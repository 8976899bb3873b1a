//! AASX (IDTA-01005): a package of OPC (ECMA-376) with a shell as JSON and the manifest of the
//! module.

use std::io::{self, Write as _};

use rawzip::{CompressionMethod, ZipArchiveWriter};

/// The manifest in the package.
pub(super) struct PackagedManifest<'m> {
    /// Its part name, as the shell refers to it: `/aasx/files/dosing.aml`.
    pub(super) path: &'m str,
    pub(super) content_type: &'m str,
    pub(super) contents: &'m [u8],
}

/// Returns the package of an environment in JSON.
pub(super) fn package(environment: &str, manifest: &PackagedManifest<'_>) -> io::Result<Vec<u8>> {
    let PackagedManifest {
        path,
        content_type,
        contents,
    } = manifest;
    let types = format!(
        "{XML}<Types xmlns=\"{CONTENT_TYPES}\">\
         <Default Extension=\"rels\" ContentType=\"{CONTENT_OF_RELATIONSHIPS}\"/>\
         <Default Extension=\"json\" ContentType=\"application/json\"/>\
         <Override PartName=\"{ORIGIN}\" ContentType=\"text/plain\"/>\
         <Override PartName=\"{path}\" ContentType=\"{content_type}\"/></Types>\n"
    );
    let [root, origin, data] = [
        relationship("aasx-origin", ORIGIN),
        relationship("aas-spec", DATA),
        relationship("aas-suppl", path),
    ];
    let parts: [(&str, &[u8]); 7] = [
        ("/[Content_Types].xml", types.as_bytes()),
        ("/_rels/.rels", &root),
        (ORIGIN, b"Intentionally empty."),
        ("/aasx/_rels/aasx-origin.rels", &origin),
        (DATA, environment.as_bytes()),
        ("/aasx/_rels/data.json.rels", &data),
        (path, contents),
    ];
    let mut out = Vec::new();
    let mut archive = ZipArchiveWriter::new(&mut out);
    for (name, contents) in parts {
        let new = archive.new_file(name.trim_start_matches('/'));
        let new = new.compression_method(CompressionMethod::STORE);
        let (mut entry, config) = new.start().map_err(io::Error::other)?;
        let mut writer = config.wrap(&mut entry);
        writer.write_all(contents)?;
        let (_, descriptor) = writer.finish().map_err(io::Error::other)?;
        entry.finish(descriptor).map_err(io::Error::other)?;
    }
    archive.finish().map_err(io::Error::other)?;
    Ok(out)
}

/// Returns the relationships of a part with one target.
fn relationship(kind: &str, target: &str) -> Vec<u8> {
    format!(
        "{XML}<Relationships xmlns=\"{RELATIONSHIPS}\"><Relationship Id=\"r1\" \
         Type=\"http://admin-shell.io/aasx/relationships/{kind}\" Target=\"{target}\"/></Relationships>\n"
    )
    .into_bytes()
}

const XML: &str = "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n";
const ORIGIN: &str = "/aasx/aasx-origin";
const DATA: &str = "/aasx/data.json";
const CONTENT_TYPES: &str = "http://schemas.openxmlformats.org/package/2006/content-types";
const RELATIONSHIPS: &str = "http://schemas.openxmlformats.org/package/2006/relationships";
const CONTENT_OF_RELATIONSHIPS: &str = "application/vnd.openxmlformats-package.relationships+xml";

#[cfg(test)]
mod tests {
    use rawzip::ZipArchive;

    use super::*;

    #[test]
    fn a_package_leads_from_its_root_to_the_shell_and_the_manifest() {
        let manifest = PackagedManifest {
            path: "/aasx/files/a%20b.aml",
            content_type: "text/xml",
            contents: b"<CAEXFile/>",
        };
        let bytes = package("{\"submodels\": []}", &manifest).unwrap();
        let archive = ZipArchive::from_slice(&bytes[..]).unwrap();
        let mut names = Vec::new();
        let mut contents = Vec::new();
        for entry in archive.entries() {
            let entry = entry.unwrap();
            let path = entry.file_path();
            names.push(String::from_utf8(path.as_ref().to_vec()).unwrap());
            let data = archive.get_entry(entry.wayfinder()).unwrap();
            contents.push(String::from_utf8(data.data().to_vec()).unwrap());
        }
        let expected = [
            "[Content_Types].xml",
            "_rels/.rels",
            "aasx/aasx-origin",
            "aasx/_rels/aasx-origin.rels",
            "aasx/data.json",
            "aasx/_rels/data.json.rels",
            "aasx/files/a%20b.aml",
        ];
        assert_eq!(names, expected);
        assert!(
            contents[0].contains("PartName=\"/aasx/files/a%20b.aml\" ContentType=\"text/xml\"")
        );
        assert!(contents[1].contains("aasx-origin\" Target=\"/aasx/aasx-origin\""));
        assert!(contents[3].contains("aas-spec\" Target=\"/aasx/data.json\""));
        assert_eq!(contents[4], "{\"submodels\": []}");
        assert!(contents[5].contains("aas-suppl\" Target=\"/aasx/files/a%20b.aml\""));
        assert_eq!(contents[6], "<CAEXFile/>");
    }
}
