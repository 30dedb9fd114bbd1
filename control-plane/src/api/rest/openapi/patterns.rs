//! Forms of texts as regular expressions (ECMA 262). Each is at least as wide as what the service takes: what it lets
//! through may still be refused, what it excludes always is.

/// Layers, nodes, services, instances, roll-outs.
pub(super) const NAME: &str = "^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$";
/// The service of a list of instances: one, or all.
pub(super) const NAME_OR_ALL: &str = "^(-|[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?)$";
/// Id of a token.
pub(super) const TOKEN_ID: &str = "^[A-Za-z0-9][A-Za-z0-9._~-]{0,127}$";
/// Key of a label.
pub(super) const LABEL_KEY: &str = "^([a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?([.][a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?)*/)?[A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?$";
/// Value of a label.
pub(super) const LABEL_VALUE: &str = "^([A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?)?$";
/// Label selector. Its keys and values are less strict here than the service is, so that it can be read.
pub(super) const SELECTOR: &str = "^[ \\t]*(![ \\t]*[A-Za-z0-9][A-Za-z0-9_./-]*|[A-Za-z0-9][A-Za-z0-9_./-]*([ \\t]*(=|==|!=)[ \\t]*[A-Za-z0-9_.-]*|[ \\t]+(in|notin)[ \\t]*[(][A-Za-z0-9_., \\t-]*[)])?)([ \\t]*,[ \\t]*(![ \\t]*[A-Za-z0-9][A-Za-z0-9_./-]*|[A-Za-z0-9][A-Za-z0-9_./-]*([ \\t]*(=|==|!=)[ \\t]*[A-Za-z0-9_.-]*|[ \\t]+(in|notin)[ \\t]*[(][A-Za-z0-9_., \\t-]*[)])?))*[ \\t]*$";
/// IP address or host name.
pub(super) const ADDRESS: &str = "^[A-Za-z0-9:]([A-Za-z0-9.:-]*[A-Za-z0-9:])?$";
/// Architecture of a node.
pub(super) const ARCHITECTURE: &str = "^[A-Za-z0-9]([A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?$";
/// Hash of a configuration, digest of a view.
pub(super) const HASH: &str = "^sha256:[0-9a-f]{64}$";
/// Page token.
pub(super) const PAGE_TOKEN: &str = "^[A-Za-z0-9_-]*$";
/// Entity tags of a precondition.
pub(super) const IF_MATCH: &str = "^([*]|(W/)?\"[!#-~]*\"([ \\t]*,[ \\t]*(W/)?\"[!#-~]*\")*)$";
/// `If-None-Match` of PUT.
pub(super) const STAR: &str = "^[*]$";
/// Idempotency key, in quotes or not.
pub(super) const IDEMPOTENCY_KEY: &str = "^([!#-~]{1,128}|\"[!#-~]{1,128}\")$";
/// Id of an event.
pub(super) const EVENT_ID: &str = "^(0|[1-9][0-9]{0,15})?$";
/// Action of the audit.
pub(super) const ACTION: &str = "^[a-z_]{1,64}$";
