-- The log: one row per commit. Its changes are in `versions`.
CREATE TABLE events (
  revision   INTEGER PRIMARY KEY,
  batch      TEXT NOT NULL,
  time       INTEGER NOT NULL,   -- ms since 1970, as all times
  subject    TEXT NOT NULL,
  request_id TEXT NOT NULL,
  changes    INTEGER NOT NULL,
  bytes      INTEGER NOT NULL
) STRICT;

-- What each document was from a revision on. Rows outlive their commit in `events` as history.
CREATE TABLE versions (
  key        TEXT NOT NULL,      -- Kind/name, Instance/service/name
  revision   INTEGER NOT NULL,
  position   INTEGER NOT NULL,   -- place in the commit
  op         TEXT NOT NULL,
  previous   INTEGER,
  time       INTEGER NOT NULL,
  subject    TEXT NOT NULL,
  request_id TEXT NOT NULL,
  paths      TEXT NOT NULL,      -- JSON
  document   TEXT NOT NULL       -- JSON
) STRICT;
CREATE UNIQUE INDEX versions_by_key ON versions (key, revision);
CREATE UNIQUE INDEX versions_by_revision ON versions (revision, position);

-- What is now.
CREATE TABLE documents (
  key      TEXT PRIMARY KEY,
  revision INTEGER NOT NULL,
  document TEXT NOT NULL         -- JSON
) STRICT;

CREATE TABLE audit (
  id         TEXT PRIMARY KEY,   -- UUIDv7: ascending in time
  time       INTEGER NOT NULL,
  revision   INTEGER,
  subject    TEXT NOT NULL,
  roles      TEXT NOT NULL,      -- JSON
  action     TEXT NOT NULL,
  kind       TEXT,
  service    TEXT,
  name       TEXT,
  allowed    INTEGER NOT NULL,
  code       TEXT,
  paths      TEXT NOT NULL,      -- JSON
  request_id TEXT NOT NULL,
  address    TEXT NOT NULL,
  detail     TEXT
) STRICT;
CREATE INDEX audit_by_time ON audit (time);

CREATE TABLE idempotency (
  id       TEXT PRIMARY KEY,
  body     TEXT NOT NULL,
  expires  INTEGER NOT NULL,
  revision INTEGER NOT NULL,
  answer   TEXT NOT NULL         -- JSON
) STRICT;
CREATE INDEX idempotency_by_expiry ON idempotency (expires);

CREATE TABLE tokens (
  id          TEXT PRIMARY KEY,  -- jti
  subject     TEXT NOT NULL,
  roles       TEXT NOT NULL,     -- JSON
  layer       TEXT,
  create_time INTEGER NOT NULL,
  expire_time INTEGER NOT NULL,
  revoke_time INTEGER
) STRICT;
CREATE INDEX tokens_by_expiry ON tokens (expire_time);
