//! Definitions in folders of the user: `share` trees, as ROS 2 installs them.
//!
//! A tree has `<package>/msg/<Name>.msg`, `srv/*.srv` and `action/*.action`, since Iron with a
//! `.json` beside each. The files of a type are read when it is asked for, so a tree may change at
//! any time.

use std::fmt;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use crate::description::{IndividualType, TypeDescription, is_type_name};
use crate::limits::MAX_DEFINITION_BYTES;
use crate::pool::{Pool, PoolError};
use crate::text::{TextError, parse_action, parse_message, parse_service};

/// A folder or file that gives no definition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Warning {
    /// The folder or file.
    pub path: PathBuf,
    /// The fault.
    pub text: String,
}

impl fmt::Display for Warning {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}: {}", self.path.display(), self.text)
    }
}

/// Folders in the order in which they are searched.
#[derive(Debug, Clone, Default)]
pub struct Folders {
    folders: Vec<PathBuf>,
}

impl Folders {
    /// The folders, and a warning for each that is not there. Such a one is searched all the same:
    /// it may come later.
    #[must_use]
    pub fn new(folders: Vec<PathBuf>) -> (Self, Vec<Warning>) {
        let missing = folders.iter().filter(|folder| !folder.is_dir());
        let warnings = missing
            .map(|folder| Warning { path: folder.clone(), text: "is not a folder".into() })
            .collect();
        (Self { folders }, warnings)
    }

    /// Descriptions of a type, one for each folder that has it, in the order of the folders. Types
    /// that it refers to are sought in the same folder, then in the others, then among `known`.
    ///
    /// Reads files: call it where that may block. Faults of files are added to `warnings`.
    pub fn describe(
        &self,
        name: &str,
        known: &Pool,
        warnings: &mut Vec<Warning>,
    ) -> Vec<TypeDescription> {
        let mut found = Vec::new();
        for folder in &self.folders {
            let mut pool = Pool::default();
            if !is_type_name(name) || !load(folder, name, &mut pool, warnings) {
                continue;
            }
            match self.complete(folder, name, pool, known, warnings) {
                Ok(description) => found.push(description),
                Err(error) => {
                    warnings.push(Warning { path: folder.clone(), text: error.to_string() });
                }
            }
        }
        found
    }

    fn complete(
        &self,
        first: &Path,
        name: &str,
        mut pool: Pool,
        known: &Pool,
        warnings: &mut Vec<Warning>,
    ) -> Result<TypeDescription, PoolError> {
        Pool::collect(name, |wanted| {
            let others = self.folders.iter().map(PathBuf::as_path);
            let _ = pool.get(wanted).is_some()
                || std::iter::once(first)
                    .chain(others)
                    .any(|folder| load(folder, wanted, &mut pool, warnings));
            pool.get(wanted).or_else(|| known.get(wanted)).cloned()
        })
    }
}

/// Adds the types of the file that defines `name` in this folder, if there is one. Whether the type
/// is in the pool then.
fn load(folder: &Path, name: &str, pool: &mut Pool, warnings: &mut Vec<Warning>) -> bool {
    let Some((package, group, base)) = split(name) else { return false };
    let stem = folder.join(package).join(group);
    for extension in ["json", group] {
        let path = stem.join(format!("{base}.{extension}"));
        match read(&path, name, base) {
            Ok(None) => {}
            Ok(Some(types)) => {
                pool.merge(types);
                if pool.get(name).is_some() {
                    return true;
                }
            }
            Err(text) => warnings.push(Warning { path, text }),
        }
    }
    false
}

/// Package, group, and the name of the file without its extension: parts of a service or action
/// have an underscore after the name that their file has.
fn split(name: &str) -> Option<(&str, &str, &str)> {
    let (package, rest) = name.split_once('/')?;
    let (group, name) = rest.split_once('/')?;
    let base = if group == "msg" { name } else { name.split('_').next()? };
    Some((package, group, base))
}

fn read(path: &Path, name: &str, base: &str) -> Result<Option<Pool>, String> {
    let Some(bytes) = contents(path).map_err(|error| error.to_string())? else { return Ok(None) };
    let mut pool = Pool::default();
    if path.extension().is_some_and(|extension| extension == "json") {
        let read = TypeDescription::from_file(&bytes).map_err(|error| error.to_string())?;
        pool.add(std::iter::once(read.type_description).chain(read.referenced_type_descriptions));
        return Ok(Some(pool));
    }
    let text = String::from_utf8(bytes).map_err(|_| "is not UTF-8".to_owned())?;
    let whole =
        name.rsplit_once('/').map_or_else(String::new, |(group, _)| format!("{group}/{base}"));
    pool.add(parse(path, &whole, &text).map_err(|error| error.to_string())?);
    Ok(Some(pool))
}

fn parse(path: &Path, name: &str, text: &str) -> Result<Vec<IndividualType>, TextError> {
    match path.extension().and_then(|extension| extension.to_str()) {
        Some("srv") => parse_service(name, text),
        Some("action") => parse_action(name, text),
        _ => parse_message(name, text).map(|ty| vec![ty]),
    }
}

/// Bytes of a file, or nothing if it is not there.
fn contents(path: &Path) -> io::Result<Option<Vec<u8>>> {
    match path.metadata() {
        Ok(data) if data.is_file() => {}
        Ok(_) => return Err(io::Error::other("is not a file")),
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error),
    }
    let limit = MAX_DEFINITION_BYTES as u64;
    let mut bytes = Vec::new();
    File::open(path)?.take(limit + 1).read_to_end(&mut bytes)?;
    if bytes.len() > MAX_DEFINITION_BYTES {
        return Err(io::Error::other(format!("is larger than {limit} bytes")));
    }
    Ok(Some(bytes))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::{Distro, built_in};

    /// A tree of files, and what [`Folders`] makes of a type in it.
    fn describe(files: &[(&str, &str)], name: &str) -> (Vec<TypeDescription>, Vec<String>) {
        let home = tempfile::tempdir().expect("a folder");
        for (path, text) in files {
            let path = home.path().join(path);
            fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
            fs::write(path, text).expect("a file");
        }
        let (folders, missing) =
            Folders::new(vec![home.path().join("one"), home.path().join("two")]);
        let mut warnings = Vec::new();
        let known = built_in(Distro::Jazzy);
        let found = folders.describe(name, &known, &mut warnings);
        let texts = missing.into_iter().chain(warnings);
        let home = format!("{}/", home.path().display());
        (found, texts.map(|warning| warning.to_string().replace(&home, "")).collect())
    }

    #[test]
    fn text_is_completed_from_the_folders_and_the_built_in_types() {
        let files = [
            ("one/a/msg/Top.msg", "Inner inner\nb/Other other\nstd_msgs/Header header\n"),
            ("one/a/msg/Inner.msg", "int8 x\n"),
            ("two/b/msg/Other.msg", "int8 y\n"),
        ];
        let (found, warnings) = describe(&files, "a/msg/Top");
        assert_eq!((found.len(), warnings.len()), (1, 0), "{warnings:?}");
        let names: Vec<&str> = found[0].types().map(|ty| ty.type_name.as_str()).collect();
        assert_eq!(
            names,
            [
                "a/msg/Top",
                "a/msg/Inner",
                "b/msg/Other",
                "builtin_interfaces/msg/Time",
                "std_msgs/msg/Header"
            ]
        );
    }

    #[test]
    fn each_folder_has_its_own() {
        let files = [("one/a/msg/B.msg", "int8 x\n"), ("two/a/msg/B.msg", "int16 x\n")];
        let (found, _) = describe(&files, "a/msg/B");
        let ids: Vec<u8> =
            found.iter().map(|each| each.type_description.fields[0].ty.type_id).collect();
        assert_eq!(ids, [2, 4]);
    }

    #[test]
    fn a_type_description_comes_before_the_text() {
        let json = r#"{"type_description_msg": {"type_description": {"type_name": "a/msg/B",
            "fields": [{"name": "x", "type": {"type_id": 9, "capacity": 0, "string_capacity": 0,
            "nested_type_name": ""}, "default_value": ""}]}, "referenced_type_descriptions": []}}"#;
        let files = [("one/a/msg/B.msg", "int8 x\n"), ("one/a/msg/B.json", json)];
        let (found, _) = describe(&files, "a/msg/B");
        assert_eq!(found[0].type_description.fields[0].ty.type_id, 9);
        let files = [("one/a/msg/B.msg", "int8 x\n"), ("one/a/msg/B.json", "{}")];
        let (found, warnings) = describe(&files, "a/msg/B");
        assert_eq!(found[0].type_description.fields[0].ty.type_id, 2);
        assert!(warnings.iter().any(|text| text.starts_with("one/a/msg/B.json: not a type")));
    }

    #[test]
    fn parts_of_services_and_actions_are_in_their_files() {
        let files = [
            ("one/a/srv/Add.srv", "int64 a\n---\nint64 sum\n"),
            ("one/a/action/Go.action", "---\n---\nfloat32 left\n"),
        ];
        for name in ["a/srv/Add_Response", "a/action/Go_SendGoal_Request", "a/action/Go_Feedback"] {
            assert_eq!(describe(&files, name).0[0].type_description.type_name, name);
        }
    }

    #[test]
    fn what_is_wrong_is_a_warning() {
        let (found, warnings) = describe(&[("one/a/msg/B.msg", "what\n")], "a/msg/B");
        assert!(found.is_empty());
        assert_eq!(
            warnings,
            [
                "two: is not a folder",
                "one/a/msg/B.msg: a/msg/B line 1: expected a type and a name, found \"what\""
            ]
        );
        let (found, warnings) = describe(&[("one/a/msg/B.msg", "C c\n")], "a/msg/B");
        assert!(found.is_empty());
        assert_eq!(warnings[1], "one: a/msg/C is not known, a/msg/B needs it");
        let large = " ".repeat(MAX_DEFINITION_BYTES + 1);
        let (_, warnings) = describe(&[("one/a/msg/B.msg", &large)], "a/msg/B");
        assert_eq!(warnings[1], "one/a/msg/B.msg: is larger than 1048576 bytes");
        assert!(describe(&[("one/a/msg/B.msg/x", "")], "a/msg/B").1[1].ends_with("not a file"));
    }

    #[test]
    fn names_do_not_leave_the_folder() {
        let files = [("secret/msg/B.msg", "int8 x\n"), ("one/a/msg/B.msg", "../secret/msg/B b\n")];
        assert!(describe(&files, "../secret/msg/B").0.is_empty());
        assert!(describe(&files, "a/msg/B").0.is_empty());
    }
}
