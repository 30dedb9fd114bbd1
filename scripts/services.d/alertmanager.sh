#!/bin/sh
# Alertmanager as it was unpacked, with the same options. It opens its template where Debian installs it, so it runs in
# a mount namespace in which /usr/share is what it was, and has that folder besides. Needs root, or user namespaces.
home=$(dirname "$(dirname "$(readlink -f "$0")")")/prometheus
program=$home/root/usr/bin/prometheus-alertmanager
[ ! -e /usr/share/prometheus/alertmanager/default.tmpl ] || exec "$program" "$@"
own=
[ "$(id -u)" = 0 ] || own=--map-root-user
mkdir -p "$home/share"
# shellcheck disable=SC2086
exec unshare $own --mount sh -ec '
  home=$1
  shift
  mount --rbind /usr/share "$home/share"
  mount -t tmpfs none /usr/share
  for entry in "$home"/share/*; do
    [ "${entry##*/}" = prometheus ] || ln -s "$entry" /usr/share/
  done
  ln -s "$home/root/usr/share/prometheus" /usr/share/prometheus
  exec "$@"
' sh "$home" "$program" "$@"
