#!/usr/bin/env bash
# Train the built-in weights, from streets to OUT/head/weights.safetensors. Start it again to continue.
#
#     runs/built_in_weights.sh hdl64e|hdl32e|any OUT [INIT] [--KEY VALUE ...]
#
# INIT are weights to begin with, such as sim-hdl64e; options of `amvnet train` may follow. An epoch has
# 6,000 scans of 1,000 streets, and each epoch has other streets. With "any", each scan is of another
# sensor that is drawn. A network takes 0.3 to 1 s for a scan on a CPU core, and 4 minutes for an epoch
# on an H100. docs/log.md says how the training of the shipped weights differed. Weights of an earlier
# recipe take a value that needs no training by runs/set_values.py:
# python runs/set_values.py OUT/head/weights.safetensors assertion.lead 2.5
set -euo pipefail
sensor=$1 out=$2
shift 2
init=()
if [[ $# -gt 0 && $1 != --* ]]; then
    init=(--init "$1")
    shift
fi

case $sensor in
    hdl64e) recipe=simulated-compact && streets=(hdl64e) ;;
    hdl32e) recipe=simulated-hdl32e-compact && streets=(hdl32e) ;;
    any) recipe=simulated-any-compact && streets=(any) ;;
    *) echo "expected hdl64e, hdl32e or any, found $sensor" >&2 && exit 2 ;;
esac
train=(amvnet train $recipe --resume)
for name in "${streets[@]}"; do train+=(--data "simulated-$name:$out/streets"); done

# Train both networks at the same time, one on each core of a small machine.
networks=(--train-sequences "$(seq -s, 0 999)" --training.rv.region_loss lovasz)
for stage in rv bev; do
    networks+=("--training.$stage.epochs" 10 "--training.$stage.batch" 8 "--training.$stage.lr" 0.002)
    networks+=("--training.$stage.warmup" 0.05 "--training.$stage.hold" 0.55 "--training.$stage.ema" 0.99)
done
networks+=(--training.bev.accumulate 4) # eight scans at once take 15 GB
export OMP_WAIT_POLICY=passive # two trainings share the cores
trap 'kill $(jobs -p) 2>/dev/null || true' EXIT
mkdir -p "$out"
for stage in rv bev; do
    # The second network takes the classes that the first one has counted.
    while [[ $stage == bev && ! -f $out/run/class_counts.npz ]] && kill -0 %1; do sleep 5; done
    OMP_NUM_THREADS=1 "${train[@]}" --out "$out/run" "${init[@]}" "${networks[@]}" --stage $stage "$@" \
        > "$out/$stage.log" 2>&1 &
done
wait %1
wait %2

# Train the head on streets that the networks have not seen, with stronger changes of the sensor and with
# disturbed scores. On streets like their own, the networks are too sure, and the head would rely on them.
"${train[@]}" --out "$out/head" --init "$out/run/weights.safetensors" --stage head \
    --train-sequences "$(seq -s, 800000 800154)" --training.head.views 1 --training.head.points 600000 \
    --training.head.epochs 10 --training.head.disturb 0.3 \
    --training.augment.tilt 4 --training.augment.height 0.4 --training.augment.drop 0.5 \
    --training.augment.intensity 0.5 --training.augment.laser_drop 0.3 "$@" > "$out/head.log" 2>&1
