#!/bin/sh
# Writes the two secret files that docker-compose.yml reads, once. They stay as they are when they exist: a database keeps the
# password it was created with, and a changed Ray token would lock running jobs out.
#
# They lie in deploy/secrets/, which .gitignore and .dockerignore name. Ray honours .gitignore too, so `ray job submit
# --working-dir .` does not upload them; a .env file at the top it would.
set -eu
cd "$(dirname "$0")"
umask 077
mkdir -p secrets

random() { od -An -N32 -tx1 /dev/urandom | tr -d ' \n'; }

write() { # NAME, then lines on standard input
    if [ -e "secrets/$1" ]; then
        cat >/dev/null
        echo "deploy/secrets/$1 is there already; left as it is"
    else
        cat >"secrets/$1.partial"
        mv "secrets/$1.partial" "secrets/$1"
        echo "deploy/secrets/$1 written"
    fi
}

printf 'RAY_AUTH_TOKEN=%s\n' "$(random)" | write ray.env
password=$(random)
# The same password twice: the first name is read by the server's image, the second by its clients.
printf 'POSTGRES_PASSWORD=%s\nPGPASSWORD=%s\n' "$password" "$password" | write postgres.env
