#!/bin/sh
# Check the free disk space before installing environments: `enough_room.sh .venv:3700 .venv45:1000`, with the installed
# size of each folder in megabytes (`du -sm`). pip also needs PIP_MB in its temporary folder.
set -eu
PIP_MB=1500

need=0
for asked in "$@"; do
    folder=${asked%:*} size=${asked##*:}
    there=0
    [ ! -d "$folder" ] || there=$(du -sm "$folder" | cut -f1)
    [ "$there" -ge "$size" ] || [ -e "$folder/ready" ] || need=$((need + size - there))
done
[ "$need" -gt 0 ] || exit 0

disk_of() { df -Pm "$1" | awk 'NR == 2 { print $1 }'; }
free_of() { df -Pm "$1" | awk 'NR == 2 { print $4 }'; }
gigabytes() { awk "BEGIN { printf \"%.1f GB\", $1 / 1000 }"; }
fail() {
    echo "Not enough disk space: $(gigabytes "$2") are free on the disk of $1, and $(gigabytes "$3") are needed for $4: free some space$5, then try again" >&2
    exit 1
}

temporary=${TMPDIR:-/tmp}
if [ "$(disk_of .)" = "$(disk_of "$temporary")" ]; then
    free=$(free_of .)
    [ "$free" -ge $((need + PIP_MB)) ] || fail "$PWD" "$free" $((need + PIP_MB)) "the Python environments and what pip downloads" ""
else
    free=$(free_of .)
    [ "$free" -ge "$need" ] || fail "$PWD" "$free" "$need" "the Python environments" ""
    free=$(free_of "$temporary")
    [ "$free" -ge "$PIP_MB" ] || fail "$temporary" "$free" "$PIP_MB" "what pip downloads" ", or name another folder with TMPDIR"
fi
