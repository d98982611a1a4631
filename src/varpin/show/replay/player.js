// Plays the page's commands in meshcat's viewer, and joins the bar below it to the viewer's animation.
// What the bar shows is in seconds of the motion; the animation counts seconds of playback at the first speed.
let viewer;

// A mesh that three.js cannot take is left out; the rest plays.
async function load() {
    const pane = document.getElementById("meshcat-pane");
    viewer = new MeshCat.Viewer(pane);
    // The viewer would take the height of the window, and draw behind the bar. The camera is set for 4 : 3; what is
    // narrower is seen from as much farther away.
    const resize = viewer.set_3d_pane_size;
    viewer.set_3d_pane_size = (width = pane.clientWidth, height = pane.clientHeight) => {
        viewer.camera.zoom = Math.min(1, 0.75 * width / height);
        resize.call(viewer, width, height);
    };
    const packed = atob(document.getElementById("commands").textContent);
    const bytes = new Uint8Array(packed.length);
    for (let i = 0; i < packed.length; i++) bytes[i] = packed.charCodeAt(i);
    const unzip = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const data = await new Response(unzip).arrayBuffer();
    const view = new DataView(data);
    // One after the other: a property or an animation needs the object that it belongs to.
    for (let at = 0; at < data.byteLength;) {
        const size = view.getUint32(at, true);
        try {
            viewer.handle_command_bytearray(new Uint8Array(data.slice(at + 4, at + 4 + size)));
        } catch (error) {
            console.error(error);
        }
        at += 4 + size;
    }
}

// What is translucent shows the facets inside it, unless its depth is drawn before its colour.
function closeGhosts() {
    for (const root of viewer.scene_tree.find(["meshcat"]).object.children) {
        if (!/^ghost( \d+)?$/.test(root.name)) continue;
        const meshes = [];
        root.traverse(node => { if (node.isMesh) meshes.push(node); });
        for (const mesh of meshes) {
            const depth = mesh.clone(false);
            depth.material = mesh.material.clone();
            depth.material.colorWrite = false;
            depth.position.set(0, 0, 0);
            depth.quaternion.set(0, 0, 0, 1);
            depth.scale.set(1, 1, 1);
            depth.updateMatrix();
            depth.renderOrder = 1;
            mesh.renderOrder = 2;
            mesh.add(depth);
        }
    }
    viewer.set_dirty();
}

function joinBar() {
    const bar = document.getElementById("bar");
    if (!bar) return;
    const animator = viewer.animator, first = Number(bar.dataset.speed), end = animator.duration;
    const button = document.getElementById("play"), slider = document.getElementById("time");
    const clock = document.getElementById("clock"), speed = document.getElementById("speed");
    const digits = end * first < 1 ? 3 : 2;
    const icons = {
        play: '<svg viewBox="0 0 14 14"><path d="M2 1l11 6-11 6z"/></svg>',
        pause: '<svg viewBox="0 0 14 14"><path d="M2 1h4v12H2zM8 1h4v12H8z"/></svg>',
    };
    let playing, shown;

    const now = () => Math.max(...animator.actions.map(action => action.time));
    function seek(time) {
        const resume = animator.playing;
        animator.pause();
        animator.seek(time);
        animator.display_progress(time);
        if (resume) animator.play();
    }
    function toggle() {
        if (animator.playing) animator.pause();
        else animator.play();
    }
    function refresh() {
        if (playing !== animator.playing) {
            playing = animator.playing;
            button.innerHTML = playing ? icons.pause : icons.play;
            button.title = button.ariaLabel = playing ? "Pause (space)" : "Play (space)";
        }
        if (shown !== now()) {
            shown = now();
            slider.value = shown;
            clock.textContent = `${(shown * first).toFixed(digits)} / ${(end * first).toFixed(digits)} s`;
        }
        requestAnimationFrame(refresh);
    }

    slider.max = end;
    slider.addEventListener("input", () => seek(Number(slider.value)));
    button.addEventListener("click", toggle);
    speed.addEventListener("change", () => { animator.mixer.timeScale = Number(speed.value) / first; });
    document.addEventListener("keydown", event => {
        if (event.target.matches("input[type=text], select")) return;
        if (event.key === " ") toggle();
        else if (event.key === "ArrowLeft") seek(Math.max(0, now() - end / 100));
        else if (event.key === "ArrowRight") seek(Math.min(end, now() + end / 100));
        else return;
        event.preventDefault();
    });
    // A button in focus would take the space bar a second time.
    button.addEventListener("keydown", event => event.preventDefault());
    refresh();
}

load().then(() => {
    closeGhosts();
    joinBar();
    // The bar has its height now.
    viewer.set_3d_pane_size();
    document.getElementById("loading").remove();
    document.documentElement.dataset.loaded = "true";
}).catch(error => {
    console.error(error);
    document.getElementById("loading").textContent = "This motion cannot be shown here: " + error.message;
});
