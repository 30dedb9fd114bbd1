//! The methods of `blaze.v1.ConfigService`, `SyncService` and `StatusService`: what right each
//! needs. A method that is not in this table is not served.

use crate::auth::Right;

/// Path of the service, with the slash before the method.
pub(super) const PATH: &str = "/blaze.v1.ConfigService/";

/// The one method of the workers, `blaze.v1.SyncService`.
pub(super) const SYNC_PATH: &str = "/blaze.v1.SyncService/Sync";

/// The one method of the monitors, `blaze.v1.StatusService`.
pub(super) const REPORT_PATH: &str = "/blaze.v1.StatusService/Report";

/// One method.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Method {
    /// As in the proto file: also for metrics and the path of an idempotency key.
    pub(super) name: &'static str,
    /// Without it the request is refused before its message is read.
    pub(super) right: Right,
    /// For the audit of refusals.
    pub(super) action: &'static str,
    /// Whether it may change something: whoever runs out of time then does not know.
    pub(super) writes: bool,
}

const fn reads(name: &'static str, action: &'static str) -> Method {
    Method { name, right: Right::Read, action, writes: false }
}

const fn writes(name: &'static str, action: &'static str) -> Method {
    Method { name, right: Right::Write, action, writes: true }
}

const fn admin(name: &'static str, action: &'static str, writes: bool) -> Method {
    Method { name, right: Right::Admin, action, writes }
}

/// All methods, in the order of the proto file.
pub(super) const METHODS: &[Method] = &[
    reads("List", "list"),
    reads("Get", "get"),
    writes("Create", "create"),
    writes("Replace", "update"),
    writes("Patch", "patch"),
    writes("Delete", "delete"),
    writes("Apply", "apply"),
    reads("GetEffective", "effective"),
    reads("ListHistory", "history"),
    reads("Diff", "diff"),
    writes("Rollback", "rollback"),
    reads("Watch", "watch"),
    writes("SetRollout", "rollout"),
    reads("GetTopology", "topology"),
    reads("ListWorkers", "workers"),
    admin("ListAudit", "audit", false),
    admin("CreateToken", "token_create", true),
    admin("RevokeToken", "token_revoke", true),
    admin("ListTokens", "tokens", false),
    reads("GetDigest", "digest"),
    admin("Trim", "trim", true),
    writes("Revert", "revert"),
];

/// What workers call. It has a stream in both directions, so neither its body nor its answer ends
/// soon.
pub(super) const SYNC: &Method =
    &Method { name: "Sync", right: Right::Sync, action: "sync", writes: false };

/// What monitors call; the same kind of stream.
pub(super) const REPORT: &Method =
    &Method { name: "Report", right: Right::Sync, action: "report", writes: false };

/// The method of a path.
pub(super) fn of_path(path: &str) -> Option<&'static Method> {
    if path == SYNC_PATH {
        return Some(SYNC);
    }
    if path == REPORT_PATH {
        return Some(REPORT);
    }
    let name = path.strip_prefix(PATH)?;
    METHODS.iter().find(|method| method.name == name)
}

#[cfg(test)]
mod tests {
    use blaze_proto::{CONFIG_DESCRIPTORS, Message as _, google};

    use super::*;

    #[test]
    fn the_table_has_every_method_of_the_proto_file() {
        let set = google::FileDescriptorSet::decode(CONFIG_DESCRIPTORS).unwrap();
        let mut services = set.file.iter().flat_map(|file| &file.service);
        let service = services.find(|service| service.name() == "ConfigService").unwrap();
        let names: Vec<_> =
            service.method.iter().map(google::MethodDescriptorProto::name).collect();
        let table: Vec<_> = METHODS.iter().map(|method| method.name).collect();
        assert_eq!(table, names);
    }

    #[test]
    fn only_exact_paths_are_methods() {
        assert_eq!(of_path("/blaze.v1.ConfigService/Get").unwrap().name, "Get");
        assert_eq!(of_path(SYNC_PATH), Some(SYNC));
        assert_eq!(of_path(REPORT_PATH), Some(REPORT));
        for path in [
            "/blaze.v1.ConfigService/get",
            "/blaze.v1.ConfigService/Get/",
            "/blaze.v1.SyncService/Get",
            "/blaze.v1.ConfigService/Sync",
            "/",
        ] {
            assert_eq!(of_path(path), None, "{path}");
        }
    }
}
